/** The dividers between the panes and above the dock: moved by pointer or arrow keys, reset by a double click. */

import { view } from "../state/view.js";
import { element } from "../ui/dom.js";

const START = { left: 0.325, middle: 0.325, dock: 0.33 };
const STEP = 0.02;
const LABELS = { left: "Width of the scan pane", middle: "Width of the photograph pane", dock: "Height of the lower panels" };
const DIRECTIONS = { ArrowLeft: -1, ArrowRight: 1, ArrowUp: 1, ArrowDown: -1 };

const LEAST_PANE = 0.12;
const LEAST_DOCK = 0.08;
const MOST_DOCK = 0.8;

const clamp = (value, least, most) => Math.min(most, Math.max(least, value));

/**
 * Compute the shares after moving a divider; every pane keeps a minimum share.
 * @param {{left: number, middle: number, dock: number}} layout shares of the window
 * @param {"left" | "middle" | "dock"} divider between scan and photograph, photograph and model, panes and dock
 * @param {number} to its new position, a share of the width from the left; for the dock, a share of the height
 * @returns {{left: number, middle: number, dock: number}}
 */
const moved = (layout, divider, to) => {
  const { left, middle, dock } = layout;
  if (divider === "dock") return { left, middle, dock: clamp(to, LEAST_DOCK, MOST_DOCK) };
  if (divider === "middle") return { left, middle: clamp(to - left, LEAST_PANE, 1 - left - LEAST_PANE), dock };
  const both = left + middle; // the other divider stays in place
  const found = clamp(to, LEAST_PANE, both - LEAST_PANE);
  return { left: found, middle: both - found, dock };
};

/** @returns {number} position of a divider, as `moved` takes it */
const positionOf = ({ left, middle, dock }, divider) => ({ left, middle: left + middle, dock })[divider];

const divider = (name, area) => {
  const level = name === "dock";
  const bar = element("div", {
    class: `divider ${level ? "level" : "upright"}`,
    role: "separator",
    tabIndex: 0,
    title: `${LABELS[name]}: drag, or use the arrow keys; double click resets it`,
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
  bar.addEventListener("pointerdown", (event) => {
    if (event.button !== 0) return;
    event.preventDefault();
    bar.focus();
    bar.setPointerCapture(event.pointerId);
    document.body.classList.add("dividing");
  });
  bar.addEventListener("pointermove", (event) => bar.hasPointerCapture(event.pointerId) && set(shareAt(event)));
  bar.addEventListener("lostpointercapture", () => document.body.classList.remove("dividing"));
  bar.addEventListener("dblclick", () => set(positionOf(START, name)));
  bar.addEventListener("keydown", (event) => {
    const direction = DIRECTIONS[event.key];
    const applies = direction && (event.key === "ArrowUp" || event.key === "ArrowDown") === level;
    if (!applies || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    event.stopPropagation();
    set(positionOf(view.get().layout, name) + direction * STEP * (event.shiftKey ? 5 : 1));
  });
  return bar;
};

/**
 * Insert the dividers.
 * @param {HTMLElement} workbench contains panes and dock
 * @param {HTMLElement} panes
 */
export const mountDividers = (workbench, panes) => {
  const dividers = { left: divider("left", panes), middle: divider("middle", panes), dock: divider("dock", workbench) };
  const [scan, photo] = panes.querySelectorAll(".pane");
  scan.after(dividers.left);
  photo.after(dividers.middle);
  panes.after(dividers.dock);
  const show = () => {
    const { layout } = view.get();
    for (const [name, share] of Object.entries(layout)) document.documentElement.style.setProperty(
      `--share-${name}`,
      share.toFixed(5),
    );
    for (const [name, bar] of Object.entries(dividers)) bar.setAttribute(
      "aria-valuenow",
      String(Math.round(100 * positionOf(layout, name))),
    );
  };
  view.on((_, changed) => changed.has("layout") && show());
  show();
};
