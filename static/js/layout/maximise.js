/** Maximising one pane over the full width. */

import { view } from "../state/view.js";
import { button } from "../ui/controls.js";
import { partOf, setChildren } from "../ui/dom.js";
import { icon } from "../ui/icons.js";

/** @typedef {"scan" | "photo" | "model"} PaneName */

const NAMES = { scan: "the scan", photo: "the photograph", model: "the model" };

/** Maximise a pane, or restore all three. @param {PaneName} name */
export const toggleMaximised = (name) => view.set({ filled: view.get().filled === name ? null : name });

/** @param {HTMLElement} panes */
export const mountMaximise = (panes) => {
  const names = /** @type {PaneName[]} */ (Object.keys(NAMES));
  /** @type {[PaneName, HTMLButtonElement][]} */
  const buttons = names.map((name) => {
    const toggle = button({
      label: `Maximise ${NAMES[name]}`,
      icon: "fill",
      bare: true,
      kind: "small fill",
      act: () => toggleMaximised(name),
    });
    partOf(panes, `#${name}-pane .pane-head`).append(toggle);
    return [name, toggle];
  });
  const show = () => {
    const { filled } = view.get();
    if (filled) panes.dataset.filled = filled;
    else delete panes.dataset.filled;
    for (const [name, toggle] of buttons) {
      const is = filled === name;
      setChildren(toggle, icon(is ? "unfill" : "fill"));
      toggle.setAttribute("aria-pressed", String(is));
      toggle.title = is ? "Restore three panes (F, Esc)" : `Maximise ${NAMES[name]} (F)`;
    }
  };
  view.on((_, changed) => changed.has("filled") && show());
  show();
};
