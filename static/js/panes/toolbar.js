/** The toolbar on each picture: tools and drawing aids. */

import { button, press } from "../ui/controls.js";
import { element } from "../ui/dom.js";

/**
 * @typedef {import("./pane.js").Pane} Pane
 * @typedef {import("../state/view.js").ViewState} ViewState
 */

/** @type {[ViewState["tool"], string, string][]} */
const TOOLS = [
  ["line", "Draw a line", "Draw a line in either picture, then its partner in the other (L)"],
  ["point", "Draw a point", "Set a point in either picture, then its partner in the other (P)"],
  ["measure", "Measure", "Measure distances, heights and more: click points in the pictures or on the model (D)"],
  ["select", "Select and move", "Select matches and move their ends (V); with other tools, hold Ctrl"],
];
/** @type {["snap" | "loupe" | "marks" | "corners", string, string][]} */
const AIDS = [
  ["snap", "Snap to edges and corners", "Snap lines to the edge under them and points to a corner (N); hold Shift to suspend"],
  ["loupe", "Loupe", "Show the loupe before drawing, too (O); while drawing it is always shown"],
  ["marks", "Matches in the pictures", "Show the matches in the pictures (X)"],
  ["corners", "Detected corners", "Show detected corners (C)"],
];

/** A click gives the focus to the picture; activation by key leaves it on the button. @param {Pane} pane @param {() => void} act */
const focusing = (pane, act) => (/** @type {Event} */ event) => {
  act();
  if (event instanceof UIEvent && event.detail > 0) pane.body.focus({ preventScroll: true });
};

/**
 * @param {import("./controller.js").Controller} controller
 * @param {import("./pane.js").Pane} pane
 */
export const mountToolbar = (controller, pane) => {
  const { view } = controller;
  /** @type {[string, HTMLButtonElement][]} */
  const tools = TOOLS.map(([name, label, title]) => {
    const activate = focusing(pane, () => view.set({ tool: name }));
    return [name, button({ label, title, icon: name, bare: true, kind: name === "select" ? "pane-button" : "pane-button edits", act: activate })];
  });
  const aids = AIDS.map(([name, label, title]) => {
    const toggle = focusing(pane, () => view.set({ [name]: view.get()[name] === false }));
    return /** @type {const} */ ([name, button({ label, title, icon: name, bare: true, kind: "pane-button", act: toggle })]);
  });
  const where = pane.side === "scan" ? "scan" : "photograph";
  pane.body.append(
    element(
      "div",
      { class: "pane-tools", role: "toolbar", "aria-label": `Tools on the ${where}`, "aria-orientation": "vertical" },
      ...tools.map(([, control]) => control),
      element("hr"),
      ...aids.map(([, control]) => control),
    ),
  );
  const show = () => {
    const state = view.get();
    for (const [name, control] of tools) press(control, state.tool === name);
    for (const [name, control] of aids) press(control, state[name] !== false);
    aids[aids.length - 1][1].hidden = !controller.store.get(`corners:${controller.store.shown()}`);
    pane.body.dataset.tool = state.tool;
  };
  view.on((_, changed) => (changed.has("tool") || changed.has("snap") || changed.has("loupe") || changed.has("marks") || changed.has("corners")) && show());
  controller.store.watch(["corners:*", "shown"], show);
  show();
};
