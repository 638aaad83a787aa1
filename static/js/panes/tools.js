/** The pointer tools: what press, move and release do: draw, accept, select, drag, frame. */

import { isTyping } from "../ui/dom.js";
import { hitAt, measurementAt, within } from "./hits.js";
import { CLICK_PX, isWhole } from "./picking.js";
import { accepts } from "./prediction.js";
import { outsideBy, toPixel } from "./viewport.js";

const PICTURE_MARGIN_PX = 8;
const DRAG_PX = 2;

/** @param {Dragged} dragged @param {number} index of an end */
const movesEnd = (dragged, index) => dragged.index === null || dragged.index === index;

/** @param {readonly number[]} a @param {readonly number[]} b @param {number} px */
const far = (a, b, px) => Math.hypot(a[0] - b[0], a[1] - b[1]) >= px;

/**
 * @typedef {"scan" | "photo"} Side
 * @typedef {import("./pane.js").Pane} Pane
 * @typedef {{id: string, side: Side, index: number | null, ends: number[][], from: number[], begun: number[],
 *   moved: boolean}} Dragged a match, or one end of it; `from`: the pixel, `begun`: the place in the pane, where it was
 *   pressed
 */

/** The pointer's strokes in both panes. */
export class Tools {
  /** @type {{side: Side, xy: number[], uv: number[], event: PointerEvent} | null} position of the pointer */
  pointer = null;
  /** @type {{side: Side, from: number[], to: number[]} | null} selection frame, in pixels */
  frame = null;
  /** @type {Dragged | null} */
  dragged = null;
  #controller;
  /** @type {{xy: number[], event: PointerEvent} | null} a press on the predicted partner, which may become a drag */
  #accepting = null;
  /** @type {Set<(pane: Pane, uv: number[]) => void>} */
  #listeners = new Set();
  /** @type {Set<(pane: Pane) => void>} */
  #leaveListeners = new Set();

  /** @param {import("./controller.js").Controller} controller */
  constructor(controller) {
    this.#controller = controller;
    controller.onSnapped = () => this.settle();
  }

  /** Move what is under the pointer to the edge or corner that holds now: a release gives what is shown. */
  settle() {
    const { pointer, dragged } = this;
    if (!pointer) return;
    const pane = this.#controller.panes[pointer.side];
    if (!pane.extent) return;
    if (dragged?.side === pane.side) this.#drag(dragged, pane, pointer.xy, pointer.uv);
    else if (this.#controller.picking.drawing) this.#controller.picking.move(pane.side, this.#positionAt(pane, pointer.xy, pointer.event));
  }

  /** @param {(pane: Pane, uv: number[]) => void} listen called when another pixel is under the pointer */
  onPointer(listen) {
    this.#listeners.add(listen);
  }

  /** The picture has moved under the pointer. @param {Pane} pane */
  pictureMoved(pane) {
    const { pointer } = this;
    if (pointer?.side !== pane.side || !pane.extent) return;
    pointer.uv = pane.pixelAt(pointer.xy);
    for (const listen of this.#listeners) listen(pane, pointer.uv);
  }

  /**
   * @param {PointerEvent} event
   * @returns {"line" | "point" | "select" | "measure"} the current tool; Ctrl or Command selects with any
   */
  #tool(event) {
    return event.ctrlKey || event.metaKey ? "select" : this.#controller.tool;
  }

  /**
   * @param {Pane} pane
   * @param {number[]} uv
   * @returns {number[][] | null} where a release at a pixel would put the point or both ends of the line being drawn,
   *   if that differs from where they were drawn
   */
  ghost(pane, uv) {
    const { snaps, snapping } = this.#controller;
    const ends = snaps && !this.dragged && this.#ends(pane, uv);
    return ends ? snapping.near(pane, ends) : null;
  }

  /** @param {Pane} pane @param {number[]} uv @returns {number[]} where a release at a pixel would put the end under the pointer */
  aim(pane, uv) {
    return this.ghost(pane, uv)?.at(-1) ?? uv;
  }

  /**
   * @param {Pane} pane
   * @param {number[]} uv
   * @returns {number[][] | null} unsnapped pixels of the point or line being placed, with its last end at a pixel
   */
  #ends(pane, uv) {
    if (this.dragged) return this.dragged.moved ? this.#shifted(this.dragged, pane, uv) : null;
    const { picking, view } = this.#controller;
    const { drawing } = picking;
    if (this.frame || !this.pointer || ["select", "measure"].includes(this.#tool(this.pointer.event))) return null;
    if (drawing && drawing.side === pane.side && drawing.kind === "line") return [drawing.from.uv, uv];
    return !drawing && picking.kindFor(pane.side, view.get().tool) === "line" ? null : [uv];
  }

  /**
   * A point is put where its corner is; a line is drawn as the pointer moves, beside its ghost.
   * @param {Pane} pane
   * @param {number[]} xy
   * @param {PointerEvent} event
   */
  #positionAt(pane, xy, event) {
    const { picking, view } = this.#controller;
    const kind = picking.drawing?.kind ?? picking.kindFor(pane.side, view.get().tool);
    const uv = pane.pixelAt(xy);
    return this.#controller.positionAt(pane.side, kind === "point" ? this.aim(pane, uv) : uv, event.timeStamp);
  }

  /**
   * @param {Side} side
   * @returns {{ends: (number[] | null)[], line: number[][] | null} | null} the predicted partner, if it belongs in this
   *   pane
   */
  offered(side) {
    const { picking, sides } = this.#controller;
    const { missingSide, predicted } = picking;
    return missingSide === side && isWhole(predicted) ? sides[side].placed(predicted) : null;
  }

  /** @param {Pane} pane @param {number[]} xy @param {PointerEvent} event @returns {"pan" | "stroke"} */
  press(pane, xy, event) {
    const controller = this.#controller;
    controller.active = pane.side;
    controller.suspended = event.shiftKey;
    this.#accepting = null;
    if (!pane.extent) return "pan";
    if (this.#tool(event) === "measure") {
      if (outsideBy(toPixel(pane.viewport, xy), pane.extent) > 0) return "pan";
      controller.measuring.press(pane.side);
      return "stroke";
    }
    const offered = this.offered(pane.side);
    if (offered && !controller.picking.drawing && accepts(offered, pane.viewport, xy, controller.look.scale)) {
      this.#accepting = { xy, event };
      return "stroke";
    }
    if (this.#tool(event) === "select" || this.#overSelectedEnd(pane, xy)) return this.#grab(pane, xy, event);
    if (outsideBy(toPixel(pane.viewport, xy), pane.extent) * pane.viewport.zoom > PICTURE_MARGIN_PX) return "pan";
    this.#draw(pane, xy, event);
    return "stroke";
  }

  /** @param {Pane} pane @param {number[]} xy @param {PointerEvent} event */
  #draw(pane, xy, event) {
    const controller = this.#controller;
    if (!controller.picking.press(pane.side, controller.view.get().tool === "point" ? "point" : "line", this.#positionAt(pane, xy, event))) return;
    if (controller.view.get().selected.size > 0) controller.select([]);
    controller.view.set({ hovered: null });
    controller.handle("drawing");
  }

  /**
   * @param {Pane} pane
   * @param {number[]} xy
   * @returns {boolean} whether any tool moves what is at a position: an end of the selected match, if nothing is begun
   */
  #overSelectedEnd(pane, xy) {
    const controller = this.#controller;
    if (controller.chosen === null || !controller.picking.idle || controller.store.readOnly) return false;
    const { selected } = controller.view.get();
    const hit = hitAt(controller.marks(pane.side), pane.viewport, xy, selected, controller.look.scale);
    return hit !== null && hit.id === controller.chosen && hit.index !== null;
  }

  /** @param {Pane} pane @param {number[]} xy @param {PointerEvent} event */
  #grab(pane, xy, event) {
    const controller = this.#controller;
    const { selected } = controller.view.get();
    const hit = hitAt(controller.marks(pane.side), pane.viewport, xy, selected, controller.look.scale);
    const adds = event.shiftKey || event.ctrlKey || event.metaKey;
    if (!hit) {
      if (event.shiftKey) {
        const uv = toPixel(pane.viewport, xy);
        this.frame = { side: pane.side, from: uv, to: uv };
        return "stroke";
      }
      controller.select([]);
      const measurement = measurementAt(controller.measured(pane.side), pane.viewport, xy, controller.look.scale);
      if (controller.view.get().measurement !== measurement) controller.view.set({ measurement });
      return "pan";
    }
    if (adds) {
      const ids = new Set(selected);
      if (!ids.delete(hit.id)) ids.add(hit.id);
      controller.select(ids);
      return "stroke";
    }
    controller.select([hit.id], hit.index);
    if (controller.store.readOnly) return "stroke";
    const pick = controller.pick(hit.id);
    if (!pick) return "stroke"; // its slice has just gone
    const ends = controller.pendingMoves.endsOf(pick, pane.side);
    this.dragged = { id: hit.id, side: pane.side, index: hit.index, ends, from: pane.pixelAt(xy), begun: xy, moved: false };
    return "stroke";
  }

  /** @param {Pane} pane @param {number[]} xy @param {PointerEvent} event */
  move(pane, xy, event) {
    const controller = this.#controller;
    controller.suspended = event.shiftKey;
    if (!pane.extent) return;
    const uv = pane.pixelAt(xy);
    if (this.pointer?.side !== pane.side) this.#enter(pane);
    this.pointer = { side: pane.side, xy, uv, event };
    controller.cursor = controller.nudged = null;
    for (const listen of this.#listeners) listen(pane, uv);
    if (this.#accepting && far(this.#accepting.xy, xy, CLICK_PX)) {
      const { xy: began, event: press } = this.#accepting;
      this.#accepting = null;
      this.#draw(pane, began, press);
    }
    if (this.frame) this.frame.to = toPixel(pane.viewport, xy);
    else if (this.dragged) this.#drag(this.dragged, pane, xy, uv);
    else if (controller.picking.drawing) controller.picking.move(pane.side, this.#positionAt(pane, xy, event));
    else if (controller.tool !== "measure") this.#hover(pane, xy, event);
    const placed = controller.view.get().snap ? this.#ends(pane, uv) : null;
    if (placed) controller.snapping.request(pane, placed);
    else controller.snapping.forget();
    pane.invalidate("live");
  }

  /** @param {Pane} pane @param {number[]} xy @param {PointerEvent} event */
  #hover(pane, xy, event) {
    const controller = this.#controller;
    const hit = hitAt(controller.marks(pane.side), pane.viewport, xy, controller.view.get().selected, controller.look.scale);
    if (controller.view.get().hovered !== (hit?.id ?? null)) controller.view.set({ hovered: hit?.id ?? null });
    const grabs = Boolean(hit) && (this.#tool(event) === "select" || this.#overSelectedEnd(pane, xy));
    pane.body.classList.toggle("grabs", grabs);
  }

  /**
   * Keys go to the pane under the pointer, unless somebody is typing; the 3-D view and the table give them back.
   * @param {Pane} pane
   */
  #enter(pane) {
    this.#controller.active = pane.side;
    if (isTyping(document.activeElement) || document.querySelector("dialog:modal, :popover-open")) return;
    pane.body.focus({ preventScroll: true });
  }

  /** @param {Dragged} dragged @param {Pane} pane @param {number[]} xy @param {number[]} uv */
  #drag(dragged, pane, xy, uv) {
    if (!dragged.moved && !far(dragged.begun, xy, DRAG_PX)) return;
    dragged.moved = true;
    const ends = this.#moved(dragged, pane, uv);
    if (ends) this.#controller.pendingMoves.show(dragged.id, dragged.side, ends);
  }

  /**
   * @param {Dragged} dragged
   * @param {Pane} pane
   * @param {number[]} uv
   * @returns {number[][] | null} the ends to show and to save, snapped where snapping finds something
   */
  #moved(dragged, pane, uv) {
    const { sides, snaps, snapping } = this.#controller;
    const shifted = this.#shifted(dragged, pane, uv);
    if (!shifted) return null;
    const placed = (snaps && snapping.near(pane, shifted)) || shifted;
    return dragged.ends.map((end, index) => (movesEnd(dragged, index) ? sides[pane.side].toWorld(placed[index]) : end));
  }

  /**
   * @param {Dragged} dragged
   * @param {Pane} pane
   * @param {number[]} uv
   * @returns {number[][] | null} pixels of all ends of the dragged match, unsnapped; null: one of them is out of view
   */
  #shifted(dragged, pane, uv) {
    const ends = [];
    for (const [index, end] of dragged.ends.entries()) {
      const was = this.#controller.sides[pane.side].toPixel(end);
      if (!was) return null;
      ends.push(movesEnd(dragged, index) ? [was[0] + uv[0] - dragged.from[0], was[1] + uv[1] - dragged.from[1]] : was);
    }
    return ends;
  }

  /** @param {Pane} pane @param {number[]} xy @param {PointerEvent} event */
  release(pane, xy, event) {
    const controller = this.#controller;
    controller.suspended = event.shiftKey;
    if (!pane.extent) return this.cancel(pane); // what was pressed in is gone
    const { dragged, frame } = this;
    if (controller.measuring.pressed) {
      controller.measuring.set(pane.side, controller.positionAt(pane.side, pane.pixelAt(xy), event.timeStamp));
    } else if (this.#accepting) {
      this.#accepting = null;
      controller.accept();
    } else if (frame) {
      this.frame = null;
      controller.select(new Set([...controller.view.get().selected, ...within(controller.marks(pane.side), frame.from, frame.to)]));
    } else if (dragged) {
      const ends = dragged.moved && this.#moved(dragged, pane, pane.pixelAt(xy));
      this.dragged = null;
      if (ends) controller.pendingMoves.commit(dragged.id, dragged.side, ends);
    } else if (controller.picking.drawing) {
      const ghost = controller.picking.drawing.kind === "line" ? this.ghost(pane, pane.pixelAt(xy)) : null;
      const snapped = ghost?.map((end) => controller.sides[pane.side].toWorld(end)) ?? null;
      controller.handle(controller.picking.release(pane.side, this.#positionAt(pane, xy, event), snapped));
    }
    return pane.invalidate("live");
  }

  /** Cancel the stroke: a second finger has come, or the system has taken the pointer. @param {Pane} pane */
  cancel(pane) {
    if (this.dragged) this.#controller.pendingMoves.drop(this.dragged.id, this.dragged.side);
    this.dragged = this.frame = this.#accepting = this.#controller.measuring.pressed = null;
    if (this.#controller.picking.drawing) this.#controller.abandon();
    pane.invalidate("live");
  }

  /** Cancel a drag or a frame, on Esc. @returns {boolean} whether there was one */
  abandon() {
    const begun = this.dragged ?? this.frame;
    if (!begun) return false;
    this.cancel(this.#controller.panes[begun.side]);
    return true;
  }

  /** @param {(pane: Pane) => void} listen called when the pointer leaves a picture */
  onLeave(listen) {
    this.#leaveListeners.add(listen);
  }

  /** @param {Pane} pane */
  leave(pane) {
    for (const listen of this.#leaveListeners) listen(pane);
    if (this.pointer?.side === pane.side) this.pointer = null;
    this.#controller.snapping.forget();
    this.#controller.view.set({ hovered: null, readout: null });
    pane.invalidate("live");
  }

  /** @returns {boolean} whether a double click fits the picture: nothing has been begun */
  mayFit() {
    return this.#controller.picking.idle && !this.dragged && this.#controller.tool !== "measure";
  }
}
