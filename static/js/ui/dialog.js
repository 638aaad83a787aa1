/** A modal dialog with a head, a body and a close button. */

import { button } from "./controls.js";
import { byId, element, newId } from "./dom.js";

/**
 * @param {string} title
 * @param {{kind?: string}} [options]
 * @param {...Node} children of the body
 * @returns {{dialog: HTMLDialogElement, body: HTMLElement, open: () => void, close: () => void}}
 */
export const makeDialog = (title, { kind = "" } = {}, ...children) => {
  const id = newId("title");
  const body = element("div", { class: "dialog-body", tabindex: "0" }, ...children);
  const dialog = element("dialog", { class: `dialog ${kind}`.trim(), "aria-labelledby": id });
  const close = () => dialog.close();
  dialog.append(
    element(
      "div",
      { class: "dialog-head" },
      element("h2", { id }, title),
      button({ label: "Close", icon: "close", kind: "plain", bare: true, act: close }),
    ),
    body,
  );
  dialog.addEventListener("click", (event) => event.target === dialog && close()); // a click on the backdrop
  byId("floating").append(dialog);
  return { dialog, body, open: () => dialog.open || dialog.showModal(), close };
};
