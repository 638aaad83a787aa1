/** The bar over a picture or the model while points are picked to be measured: kind, value, and what to do next. */

import { MEASURES, measurementOf } from "../state/measuring.js";
import { button, choice, fill } from "../ui/controls.js";
import { element, setText } from "../ui/dom.js";

const KINDS = /** @type {import("../state/view.js").ViewState["measures"][]} */ (Object.keys(MEASURES));

/**
 * @param {import("./controller.js").Controller} controller
 * @param {HTMLElement} body of the picture or the model
 */
export const mountMeasureBar = (controller, body) => {
  const { view, measuring, store } = controller;
  const kind = choice("What is measured", (name) => {
    const chosen = KINDS.find((each) => each === name);
    if (chosen) view.set({ measures: chosen });
  });
  const value = element("strong", { class: "figures" });
  const said = element("span", { role: "status" });
  const refocus = () => body.focus({ preventScroll: true });
  /** @param {string} label @param {string} sign @param {() => void} run */
  const act = (label, sign, run) => button({ label, icon: sign, bare: true, kind: "pane-button", act: () => (run(), refocus()) });
  const finish = act("Finish the measurement (Enter)", "tick", () => measuring.finish());
  const back = act("Take the last point back (Esc)", "undo", () => measuring.abandon());
  const stop = act("Stop measuring", "close", () => view.set({ tool: "select" }));
  const bar = element(
    "div",
    { class: "pane-measure", role: "toolbar", "aria-label": "Measuring" },
    kind, element("p", {}, value, said), finish, back, stop,
  );
  body.append(bar);
  const show = () => {
    const { tool, measures } = view.get();
    bar.hidden = tool !== "measure" || store.readOnly;
    if (bar.hidden) return;
    fill(kind, KINDS.map((name) => [name, MEASURES[name].label]), measures);
    const last = measuring.said ? null : measurementOf(measuring.made);
    const found = last ?? measuring.soFar;
    setText(value, found ? (last?.refusal || [last?.name, found.value].filter(Boolean).join(": ")) : "");
    const notes = found?.notes ?? [];
    setText(said, measuring.said || (notes.length ? notes[0] : found ? "" : measuring.hint.split(" · ")[0]));
    said.classList.toggle("warn", Boolean(measuring.said && measuring.said !== "Measuring …") || notes.length > 0);
    finish.hidden = !measuring.finishable;
    back.hidden = measuring.places.length === 0;
  };
  measuring.onChange(show);
  view.on((_, changed) => (changed.has("tool") || changed.has("measures")) && show());
  store.watch(["measurements", "measured", "people"], show);
  show();
};
