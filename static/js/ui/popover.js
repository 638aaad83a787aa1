/** Panels that open below a button and close on a click elsewhere (native popovers). */

import { element, newId } from "./dom.js";

const MARGIN_PX = 8;

/** @param {Event} event of a popover @returns {boolean} whether it opens */
export const opens = (event) => /** @type {ToggleEvent} */ (event).newState === "open";

/** Place a panel below its button: aligned left in the left half of the window, else aligned right. @param {HTMLElement} panel @param {HTMLElement} opener */
const place = (panel, opener) => {
  const box = opener.getBoundingClientRect();
  const room = document.documentElement.clientWidth;
  const onLeft = box.left + box.right < room;
  panel.style.setProperty("left", onLeft ? `${Math.max(MARGIN_PX, box.left)}px` : "auto");
  panel.style.setProperty("right", onLeft ? "auto" : `${Math.max(MARGIN_PX, room - box.right)}px`);
  panel.style.setProperty("top", `${box.bottom + 6}px`);
  panel.style.setProperty("--popover-top", `${box.bottom + 6}px`);
};

/**
 * Attach a panel to a button.
 * @param {HTMLButtonElement} opener
 * @param {string} label of the panel
 * @param {...Node} children
 * @returns {HTMLElement} the panel
 */
export const popoverOf = (opener, label, ...children) => {
  const panel = element(
    "div",
    { class: "popover", id: newId("popover"), role: "dialog", "aria-label": label, popover: "auto" },
    ...children,
  );
  opener.popoverTargetElement = panel;
  opener.setAttribute("aria-haspopup", "dialog");
  // before it is shown: on a busy page `toggle` is late, and the panel would first appear in the corner
  panel.addEventListener("beforetoggle", (event) => opens(event) && place(panel, opener));
  panel.addEventListener("toggle", (event) => opener.setAttribute("aria-expanded", String(opens(event))));
  opener.setAttribute("aria-expanded", "false");
  opener.after(panel);
  return panel;
};
