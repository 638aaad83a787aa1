/** On a narrow screen one pane is shown at a time, or the matches with the steps; this bar chooses. */

import { element } from "../ui/dom.js";

const PARTS = { scan: "Scan", photo: "Photograph", model: "Model", dock: "Matches" };

/** @param {HTMLElement} workbench */
export const mountSwitcher = (workbench) => {
  const buttons = Object.entries(PARTS).map(([name, label]) =>
    element("button", { type: "button", class: "button plain small", on: { click: () => show(name) } }, label),
  );
  /** @param {string} name */
  const show = (name) => {
    workbench.dataset.only = name;
    buttons.forEach((button, k) => button.setAttribute("aria-pressed", String(Object.keys(PARTS)[k] === name)));
  };
  workbench.prepend(element("nav", { class: "switcher", "aria-label": "Shown part" }, ...buttons));
  show("scan");
};
