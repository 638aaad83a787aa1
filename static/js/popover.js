/** Panels that open below a button and close by themselves (the browser's own popover). */

import { element, newId } from "./dom.js";

const MARGIN_PX = 8;

/** Put a panel below what it belongs to, within the window. */
const place = (panel, opener) => {
  const box = opener.getBoundingClientRect();
  const room = document.documentElement.clientWidth;
  const left = Math.max(MARGIN_PX, Math.min(box.left, room - panel.offsetWidth - MARGIN_PX));
  panel.style.setProperty("left", `${left}px`);
  panel.style.setProperty("top", `${box.bottom + 6}px`);
};

/**
 * Give a button a panel.
 * @param {HTMLButtonElement} opener
 * @param {string} label of the panel
 * @param {...Node} children
 * @returns {HTMLElement} the panel; `opened` is called on it at each `toggle` event
 */
export const popoverOf = (opener, label, ...children) => {
  const panel = element(
    "div",
    { class: "popover", id: newId("popover"), role: "dialog", "aria-label": label, popover: "auto" },
    ...children,
  );
  opener.popoverTargetElement = panel;
  opener.setAttribute("aria-haspopup", "dialog");
  panel.addEventListener("toggle", (event) => {
    opener.setAttribute("aria-expanded", String(event.newState === "open"));
    if (event.newState === "open") place(panel, opener);
  });
  opener.setAttribute("aria-expanded", "false");
  opener.after(panel);
  return panel;
};
