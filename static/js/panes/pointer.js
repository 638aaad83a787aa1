/**
 * Pointers, wheel and fingers, told apart: strokes of the tool in hand, panning, zooming. Right, middle and Space with
 * any button pan; one finger draws, two pan and zoom.
 */

import { allowed, moved, wheelFactor, zoomedAbout } from "./viewport.js";

/** @returns {boolean} whether a pointer is on what stands upon the picture and has its own use of it */
const isControl = (target) => Boolean(target.closest?.("button, input, select, [role=slider], [role=toolbar]"));

/**
 * @typedef {object} Strokes
 * @property {(pane: any, xy: number[], event: PointerEvent) => "pan" | "stroke"} press
 * @property {(pane: any, xy: number[], event: PointerEvent) => void} move pressed or not
 * @property {(pane: any, xy: number[], event: PointerEvent) => void} release
 * @property {(pane: any) => void} cancel the stroke has become something else
 * @property {(pane: any) => void} leave
 * @property {(pane: any) => boolean} mayFit whether a double click fits
 */

/**
 * @param {import("./pane.js").Pane} pane
 * @param {Strokes} strokes
 * @param {{held: boolean, used: boolean}} space the space bar
 */
export const listenToPointers = (pane, strokes, space) => {
  const { body } = pane;
  const fingers = new Map();
  /** @type {{mode: "pan" | "stroke" | "pinch", pointer: number, last: number[]} | null} */
  let going = null;

  const pinch = () => {
    const [a, b] = [...fingers.values()];
    return { middle: [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2], apart: Math.max(20, Math.hypot(a[0] - b[0], a[1] - b[1])) };
  };
  let pinched = null;
  let last = null;

  /** Wheels are told in whole CSS pixels; the pointer's last move knows better. */
  const placeOf = (event) => {
    const xy = pane.at(event);
    return last && Math.hypot(last[0] - xy[0], last[1] - xy[1]) < 2 ? last : xy;
  };

  const begin = (event, xy, mode) => {
    going = { mode, pointer: event.pointerId, last: xy };
    body.setPointerCapture(event.pointerId);
    body.classList.toggle("panning", mode === "pan");
  };

  const end = () => {
    going = null;
    body.classList.remove("panning");
  };

  body.addEventListener("pointerdown", (event) => {
    if (isControl(event.target)) return;
    const xy = pane.at(event);
    body.classList.add("by-pointer"); // no ring of focus around what the hand is at anyway
    body.focus({ preventScroll: true });
    if (event.pointerType === "touch") {
      fingers.set(event.pointerId, xy);
      if (fingers.size === 2) {
        if (going?.mode === "stroke") strokes.cancel(pane);
        begin(event, xy, "pinch");
        pinched = pinch();
      }
      if (fingers.size > 1) return;
    }
    if (going) return;
    event.preventDefault(); // no text selection, no scroll by the middle button
    const pans = event.button === 1 || event.button === 2 || space.held;
    if (space.held) space.used = true;
    begin(event, xy, pans ? "pan" : strokes.press(pane, xy, event));
  });

  body.addEventListener("pointermove", (event) => {
    const began = performance.now();
    const xy = pane.at(event);
    last = xy;
    if (fingers.has(event.pointerId)) fingers.set(event.pointerId, xy);
    if (going?.mode === "pinch") {
      if (fingers.size < 2) return;
      const now = pinch();
      const shifted = moved(pane.viewport, [now.middle[0] - pinched.middle[0], now.middle[1] - pinched.middle[1]]);
      const zoom = allowed((pane.viewport.zoom * now.apart) / pinched.apart, pane.size, pane.extent ?? [1, 1]);
      if (pane.extent) pane.place(zoomedAbout(shifted, now.middle, zoom), "hand");
      pinched = now;
      return;
    }
    if (going && going.pointer !== event.pointerId) return;
    if (!going && isControl(event.target)) {
      strokes.leave(pane);
      return;
    }
    if (going?.mode === "pan") {
      pane.place(moved(pane.viewport, [xy[0] - going.last[0], xy[1] - going.last[1]]), "hand");
      going.last = xy;
    } else strokes.move(pane, xy, event);
    pane.noteMove(began);
  });

  body.addEventListener("pointerup", (event) => {
    fingers.delete(event.pointerId);
    if (going?.mode === "pinch") {
      if (fingers.size === 0) end();
      return;
    }
    if (going?.pointer !== event.pointerId) return;
    const { mode } = going;
    end();
    if (mode === "stroke") strokes.release(pane, pane.at(event), event);
  });

  body.addEventListener("pointercancel", (event) => {
    fingers.delete(event.pointerId);
    if (going?.mode === "stroke" && going.pointer === event.pointerId) strokes.cancel(pane);
    if (fingers.size === 0) end();
  });

  body.addEventListener("pointerleave", () => going || strokes.leave(pane));
  body.addEventListener("contextmenu", (event) => event.preventDefault());
  body.addEventListener("dblclick", (event) => {
    if (isControl(event.target)) return;
    if (strokes.mayFit(pane)) pane.fit("hand");
  });
  body.addEventListener("keydown", () => body.classList.remove("by-pointer"));
  body.addEventListener("blur", () => body.classList.remove("by-pointer"));
  body.addEventListener("wheel", (event) => {
    if (event.target.closest?.("[popover]")) return;
    event.preventDefault();
    pane.zoomTo(pane.viewport.zoom * wheelFactor(event), "hand", placeOf(event));
  }, { passive: false });
};
