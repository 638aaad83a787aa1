/**
 * Pointer, wheel and touch events of a pane, dispatched to the tools, to panning and to zooming. The right and middle
 * button, or Space with any button, pan; one finger draws, two pan and zoom.
 */

import { allowed, moved, wheelFactor, zoomedAbout } from "./viewport.js";

/** @param {EventTarget | null} target @returns {boolean} whether an element over the picture handles the pointer itself */
const isControl = (target) => target instanceof Element && Boolean(target.closest("button, input, select, [role=slider], [role=toolbar]"));

/**
 * @typedef {import("./pane.js").Pane} Pane
 * @typedef {"pan" | "stroke" | "pinch"} Mode
 */
/**
 * @typedef {object} PointerTools
 * @property {(pane: Pane, xy: number[], event: PointerEvent) => "pan" | "stroke"} press
 * @property {(pane: Pane, xy: number[], event: PointerEvent) => void} move with or without a button
 * @property {(pane: Pane, xy: number[], event: PointerEvent) => void} release
 * @property {(pane: Pane) => void} cancel the stroke has become another gesture
 * @property {(pane: Pane) => void} leave
 * @property {(pane: Pane) => boolean} mayFit whether a double click fits the picture
 */

/**
 * @param {import("./pane.js").Pane} pane
 * @param {PointerTools} tools
 * @param {{held: boolean, used: boolean}} space whether the space bar is held, and has panned meanwhile
 */
export const listenToPointers = (pane, tools, space) => {
  const { body } = pane;
  /** @type {Map<number, number[]>} */
  const fingers = new Map();
  /** @type {{mode: Mode, pointer: number, last: number[]} | null} */
  let gesture = null;

  const pinch = () => {
    const [a, b] = [...fingers.values()];
    return { middle: [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2], apart: Math.max(20, Math.hypot(a[0] - b[0], a[1] - b[1])) };
  };
  /** @type {ReturnType<typeof pinch> | null} */
  let pinched = null;
  /** @type {number[] | null} */
  let last = null;

  /** Wheel events have whole CSS pixels; the last pointer move is more precise. @param {MouseEvent} event */
  const positionOf = (event) => {
    const xy = pane.at(event);
    return last && Math.hypot(last[0] - xy[0], last[1] - xy[1]) < 2 ? last : xy;
  };

  /** @param {PointerEvent} event @param {number[]} xy @param {Mode} mode */
  const begin = (event, xy, mode) => {
    gesture = { mode, pointer: event.pointerId, last: xy };
    body.setPointerCapture(event.pointerId);
    body.classList.toggle("panning", mode === "pan");
  };

  const end = () => {
    gesture = null;
    body.classList.remove("panning");
  };

  body.addEventListener("pointerdown", (event) => {
    if (isControl(event.target)) return;
    const xy = pane.at(event);
    body.classList.add("by-pointer"); // no focus ring while the pointer is used
    body.focus({ preventScroll: true });
    if (event.pointerType === "touch") {
      fingers.set(event.pointerId, xy);
      if (fingers.size === 2) {
        if (gesture?.mode === "stroke") tools.cancel(pane);
        begin(event, xy, "pinch");
        pinched = pinch();
      }
      if (fingers.size > 1) return;
    }
    if (gesture) return;
    event.preventDefault(); // no text selection, no autoscroll by the middle button
    const pans = event.button === 1 || event.button === 2 || space.held;
    if (space.held) space.used = true;
    begin(event, xy, pans ? "pan" : tools.press(pane, xy, event));
  });

  body.addEventListener("pointermove", (event) => {
    const began = performance.now();
    const xy = pane.at(event);
    last = xy;
    if (fingers.has(event.pointerId)) fingers.set(event.pointerId, xy);
    if (gesture?.mode === "pinch") {
      if (fingers.size < 2 || !pinched) return;
      const now = pinch();
      const shifted = moved(pane.viewport, [now.middle[0] - pinched.middle[0], now.middle[1] - pinched.middle[1]]);
      const zoom = allowed((pane.viewport.zoom * now.apart) / pinched.apart, pane.size, pane.extent ?? [1, 1]);
      if (pane.extent) pane.place(zoomedAbout(shifted, now.middle, zoom), "hand");
      pinched = now;
      return;
    }
    if (gesture && gesture.pointer !== event.pointerId) return;
    if (!gesture && isControl(event.target)) {
      tools.leave(pane);
      return;
    }
    if (gesture?.mode === "pan") {
      pane.place(moved(pane.viewport, [xy[0] - gesture.last[0], xy[1] - gesture.last[1]]), "hand");
      gesture.last = xy;
    } else tools.move(pane, xy, event);
    pane.noteMove(began);
  });

  body.addEventListener("pointerup", (event) => {
    fingers.delete(event.pointerId);
    if (gesture?.mode === "pinch") {
      if (fingers.size === 0) end();
      return;
    }
    if (gesture?.pointer !== event.pointerId) return;
    const { mode } = gesture;
    end();
    if (mode === "stroke") tools.release(pane, pane.at(event), event);
  });

  body.addEventListener("pointercancel", (event) => {
    fingers.delete(event.pointerId);
    if (gesture?.mode === "stroke" && gesture.pointer === event.pointerId) tools.cancel(pane);
    if (fingers.size === 0) end();
  });

  body.addEventListener("pointerleave", () => gesture || tools.leave(pane));
  body.addEventListener("contextmenu", (event) => event.preventDefault());
  body.addEventListener("dblclick", (event) => {
    if (isControl(event.target)) return;
    if (tools.mayFit(pane)) pane.fit("hand");
  });
  body.addEventListener("keydown", () => body.classList.remove("by-pointer"));
  body.addEventListener("blur", () => body.classList.remove("by-pointer"));
  body.addEventListener("wheel", (event) => {
    if (/** @type {Element} */ (event.target).closest?.("[popover]")) return;
    event.preventDefault();
    pane.zoomTo(pane.viewport.zoom * wheelFactor(event), "hand", positionOf(event));
  }, { passive: false });
};
