/** Dark, light, or as the system has it. */

import { view } from "../state/view.js";

const KEY = "ladarreg-theme";
const ORDER = ["system", "dark", "light"];
const preferred = matchMedia("(prefers-color-scheme: light)");

const apply = () => {
  const { theme } = view.get();
  const light = theme === "light" || (theme === "system" && preferred.matches);
  document.documentElement.dataset.theme = light ? "light" : "dark";
};

/** @returns {"dark" | "light"} what is shown now */
export const shownTheme = () => (document.documentElement.dataset.theme === "light" ? "light" : "dark");

/** Take the next of system, dark and light, and keep it for the next visit. */
export const nextTheme = () => {
  const theme = ORDER[(ORDER.indexOf(view.get().theme) + 1) % ORDER.length];
  try {
    localStorage.setItem(KEY, theme);
  } catch {
    // storage is off: it holds for this page
  }
  view.set({ theme });
};

/** Follow the choice and the system from now on. */
export const followTheme = () => {
  let theme = null;
  try {
    theme = localStorage.getItem(KEY);
  } catch {
    // storage is off
  }
  // Before anybody redraws by it: canvases read the colours that this sets.
  view.on((state, changed) => changed.has("theme") && apply());
  preferred.addEventListener("change", () => {
    apply();
    view.set({ theme: "dark" === view.get().theme ? "dark" : view.get().theme });
  });
  view.set({ theme: ORDER.includes(theme) ? theme : "system" });
  apply();
};
