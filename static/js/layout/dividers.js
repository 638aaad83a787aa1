/** The dividers between the panes and above the dock: by pointer, by arrow keys, by double click back to the start. */

import { element } from "../ui/dom.js";
import { moved, placeOf } from "./pane_sizes.js";
import { view } from "../state/view.js";

const START = { left: 0.325, middle: 0.325, dock: 0.33 };
const STEP = 0.02;
const LABELS = { left: "Width of the scan", middle: "Width of the photograph", dock: "Height of the lower part" };
const INTO = { ArrowLeft: -1, ArrowRight: 1, ArrowUp: 1, ArrowDown: -1 };

const divider = (name, area) => {
  const level = name === "dock";
  const made = element("div", {
    class: `divider ${level ? "level" : "upright"}`,
    role: "separator",
    tabIndex: 0,
    title: `${LABELS[name]}: drag, or arrow keys; double click: as at first`,
    "aria-label": LABELS[name],
    "aria-orientation": level ? "horizontal" : "vertical",
    "aria-valuemin": 0,
    "aria-valuemax": 100,
  });
  const set = (to) => view.set({ layout: moved(view.get().layout, name, to) });
  const shareAt = (event) => {
    const box = area.getBoundingClientRect();
    return level ? (box.bottom - event.clientY) / box.height : (event.clientX - box.left) / box.width;
  };
  made.addEventListener("pointerdown", (event) => {
    if (event.button !== 0) return;
    event.preventDefault();
    made.focus();
    made.setPointerCapture(event.pointerId);
    document.body.classList.add("dividing");
  });
  made.addEventListener("pointermove", (event) => made.hasPointerCapture(event.pointerId) && set(shareAt(event)));
  made.addEventListener("lostpointercapture", () => document.body.classList.remove("dividing"));
  made.addEventListener("dblclick", () => set(placeOf(START, name)));
  made.addEventListener("keydown", (event) => {
    const into = INTO[event.key];
    const ours = into && (event.key === "ArrowUp" || event.key === "ArrowDown") === level;
    if (!ours || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    event.stopPropagation();
    set(placeOf(view.get().layout, name) + into * STEP * (event.shiftKey ? 5 : 1));
  });
  return made;
};

/**
 * @param {HTMLElement} workbench holds panes and dock
 * @param {HTMLElement} panes
 */
export const mountDividers = (workbench, panes) => {
  const made = { left: divider("left", panes), middle: divider("middle", panes), dock: divider("dock", workbench) };
  const [scan, photo] = panes.querySelectorAll(".pane");
  scan.after(made.left);
  photo.after(made.middle);
  panes.after(made.dock);
  const show = () => {
    const { layout } = view.get();
    for (const [name, share] of Object.entries(layout)) document.documentElement.style.setProperty(
      `--share-${name}`,
      share.toFixed(5),
    );
    for (const [name, bar] of Object.entries(made)) bar.setAttribute(
      "aria-valuenow",
      String(Math.round(100 * placeOf(layout, name))),
    );
  };
  view.on((_, changed) => changed.has("layout") && show());
  show();
};
