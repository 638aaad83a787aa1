/** One pane over the whole width, and back. */

import { button, put } from "../ui/dom.js";
import { icon } from "../ui/icons.js";
import { view } from "../state/view.js";

const NAMES = { scan: "the scan", photo: "the photograph", model: "the model" };

/** @param {"scan" | "photo" | "model"} name */
export const toggleFilled = (name) => view.set({ filled: view.get().filled === name ? null : name });

/** @param {HTMLElement} panes */
export const mountFilling = (panes) => {
  const buttons = Object.keys(NAMES).map((name) => {
    const made = button({
      label: `Fill the width with ${NAMES[name]}`,
      icon: "fill",
      bare: true,
      kind: "small fill",
      act: () => toggleFilled(name),
    });
    panes.querySelector(`#${name}-pane .pane-head`).append(made);
    return [name, made];
  });
  const show = () => {
    const { filled } = view.get();
    if (filled) panes.dataset.filled = filled;
    else delete panes.dataset.filled;
    for (const [name, made] of buttons) {
      const is = filled === name;
      put(made, icon(is ? "unfill" : "fill"));
      made.setAttribute("aria-pressed", String(is));
      made.title = is ? "Back to three panes (F, Esc)" : `Fill the width with ${NAMES[name]} (F)`;
    }
  };
  view.on((_, changed) => changed.has("filled") && show());
  show();
};
