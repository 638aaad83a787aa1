/** A question inside a dialog: what would happen, and whether to go on. */

import { button } from "../../ui/controls.js";
import { element, setChildren } from "../../ui/dom.js";

/**
 * @param {string} label of the question, for screen readers
 * @param {string} goOn text of the button that goes on
 * @returns {{box: HTMLElement, ask: (reasons: string[], act: () => void) => void}}
 */
export const confirmation = (label, goOn) => {
  const list = element("ul", { class: "reasons" });
  const go = button({ label: goOn, kind: "primary" });
  const stay = button({ label: "Stay here", kind: "plain", act: () => (box.hidden = true) });
  const box = element(
    "section",
    { class: "file-question", role: "alertdialog", "aria-label": label, hidden: true },
    list,
    element("div", { class: "row" }, go, stay),
  );
  /** @param {string[]} reasons @param {() => void} act */
  const ask = (reasons, act) => {
    setChildren(list, ...reasons.map((reason) => element("li", {}, reason)));
    go.onclick = () => {
      box.hidden = true;
      act();
    };
    box.hidden = false;
    stay.focus();
  };
  return { box, ask };
};
