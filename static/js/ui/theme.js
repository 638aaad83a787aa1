/** The colour theme: dark, light, or whatever the system prefers. */

/** @typedef {"system" | "dark" | "light"} Theme */

const KEY = "ladarreg-theme";
/** @type {Theme[]} */
const THEMES = ["system", "dark", "light"];
const systemLight = matchMedia("(prefers-color-scheme: light)");

const listeners = new Set();
/** @type {Theme} */
let chosen = "system";

const apply = () => {
  const light = chosen === "light" || (chosen === "system" && systemLight.matches);
  document.documentElement.dataset.theme = light ? "light" : "dark";
  for (const listen of listeners) listen();
};

/** @returns {Theme} the theme that was chosen, not the one that results */
export const chosenTheme = () => chosen;

/**
 * Call `listen()` after each change of the theme, once its colours are in place.
 * @param {() => void} listen
 */
export const onTheme = (listen) => {
  listeners.add(listen);
};

/** Switch to the next of system, dark and light, and remember it. */
export const nextTheme = () => {
  chosen = THEMES[(THEMES.indexOf(chosen) + 1) % THEMES.length];
  try {
    localStorage.setItem(KEY, chosen);
  } catch {
    // storage is disabled: the choice lasts as long as this page
  }
  apply();
};

/** Apply the stored choice, and follow the system from now on. */
export const followTheme = () => {
  try {
    const stored = /** @type {Theme} */ (localStorage.getItem(KEY));
    if (THEMES.includes(stored)) chosen = stored;
  } catch {
    // storage is disabled
  }
  systemLight.addEventListener("change", apply);
  apply();
};
