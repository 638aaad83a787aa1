/** The tools, at the border of each picture: what the pointer does, and what helps it. */

import { element } from "../ui/dom.js";
import { button, press } from "../ui/controls.js";
import { icon } from "./tool_icons.js";

const TOOLS = [
  ["line", "Draw a line", "Draw a line in either picture, then its partner in the other (L)"],
  ["point", "Draw a point", "Set a point in either picture, then its partner in the other (P)"],
  ["select", "Select and move", "Select matches and move their ends (V); with other tools, hold Ctrl"],
];
const HELPS = [
  ["snap", "Snap to corners", "Ends go to the nearest corner (N); hold Alt for the opposite"],
  ["loupe", "Loupe", "Loupe before a line is begun, too (O); while drawing it is always there"],
  ["corners", "Found corners", "Show the corners that were found (C)"],
];

/** A press by hand leaves the keyboard with the picture; one by key stays where it is. */
const handing = (pane, act) => (event) => {
  act();
  if (event.detail > 0) pane.body.focus({ preventScroll: true });
};

/** @param {import("./controller.js").Desk} desk @param {import("./pane.js").Pane} pane */
export const mountToolbox = (desk, pane) => {
  const { view } = desk;
  const tools = TOOLS.map(([name, label, title]) => {
    const take = handing(pane, () => view.set({ tool: name }));
    return [name, button(label, title, take, icon(name))];
  });
  const helps = HELPS.map(([name, label, title]) => {
    const turn = handing(pane, () => view.set({ [name]: view.get()[name] === false }));
    return [name, button(label, title, turn, icon(name))];
  });
  const where = pane.side === "scan" ? "scan" : "photograph";
  pane.body.append(
    element(
      "div",
      { class: "pane-tools", role: "toolbar", "aria-label": `Tools on the ${where}`, "aria-orientation": "vertical" },
      ...tools.map(([, made]) => made),
      element("hr"),
      ...helps.map(([, made]) => made),
    ),
  );
  const show = () => {
    const state = view.get();
    for (const [name, made] of tools) press(made, state.tool === name);
    for (const [name, made] of helps) press(made, state[name] !== false);
    helps.at(-1)[1].hidden = !desk.store.get(`corners:${desk.store.shown()}`);
    pane.body.dataset.tool = state.tool;
  };
  view.on((_, changed) => (changed.has("tool") || changed.has("snap") || changed.has("loupe") || changed.has("corners")) && show());
  desk.store.watch(["corners:*", "shown"], show);
  show();
};
