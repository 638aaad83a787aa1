/** What a press, a move and a release do with the tool in hand: draw, accept, select, drag, frame. */

import { hitAt, within } from "./hits.js";
import { accepts } from "./prediction.js";
import { CLICK_PX } from "./picking.js";
import { outsideBy, toPixel } from "./viewport.js";

const BESIDE_PICTURE_PX = 8;
const DRAG_PX = 2;

const far = (a, b, px) => Math.hypot(a[0] - b[0], a[1] - b[1]) >= px;

/** Strokes of the pointer on the desk. */
export class Strokes {
  /** @type {{side: string, xy: number[], uv: number[], event: PointerEvent} | null} where the pointer is */
  pointer = null;
  /** @type {{side: string, from: number[], to: number[]} | null} pixels: the frame of a selection */
  frame = null;
  /** @type {{id: string, side: string, index: number | null, ends: number[][], from: number[], moved: boolean} | null} */
  dragged = null;
  #desk;
  #yes = null;
  #listeners = new Set();

  /** @param {import("./controller.js").Desk} desk */
  constructor(desk) {
    this.#desk = desk;
    desk.onSnapped = () => this.#settle();
  }

  /** The end under the pointer goes to the corner that has just been told: what is seen is what a release gives. */
  #settle() {
    const { pointer } = this;
    const pane = pointer && this.#desk.panes[pointer.side];
    if (!pane?.extent) return;
    if (this.dragged?.side === pane.side) this.#drag(pane, pointer.xy, pointer.uv);
    else if (this.#desk.picking.drawing) this.#desk.picking.move(pane.side, this.#place(pane, pointer.xy, pointer.event));
  }

  /** @param {(pane: any, uv: number[]) => void} listen called when the pointer comes to another pixel */
  onPointer(listen) {
    this.#listeners.add(listen);
  }

  /** Another pixel is under the pointer now, though the pointer has not moved. */
  pictureMoved(pane) {
    if (this.pointer?.side !== pane.side || !pane.extent) return;
    this.pointer.uv = pane.pixelAt(this.pointer.xy);
    for (const listen of this.#listeners) listen(pane, this.pointer.uv);
  }

  /** @returns {"line" | "point" | "select"} Ctrl or Command selects with any tool */
  #tool(event) {
    return event.ctrlKey || event.metaKey ? "select" : this.#desk.view.get().tool;
  }

  /** The pixel that is meant: the corner within reach, where ends go to corners. */
  aim(pane, uv) {
    return (this.#desk.snaps && this.#desk.snapping.near(pane, uv)) || uv;
  }

  #place(pane, xy, event) {
    const uv = this.aim(pane, pane.pixelAt(xy));
    return this.#desk.placeAt(pane.side, uv, event.timeStamp);
  }

  /** @returns {{ends: (number[] | null)[], line: number[][] | null} | null} the offered partner, if it is in this pane */
  offered(side) {
    const { picking, sides } = this.#desk;
    return picking.wanted === side && picking.acceptable ? sides[side].placed(picking.predicted) : null;
  }

  /** @returns {"pan" | "stroke"} */
  press(pane, xy, event) {
    const desk = this.#desk;
    desk.active = pane.side;
    desk.inverted = event.altKey;
    this.#yes = null;
    if (!pane.extent) return "pan";
    const offered = this.offered(pane.side);
    if (offered && !desk.picking.drawing && accepts(offered, pane.viewport, xy, desk.look.scale)) {
      this.#yes = { xy, event };
      return "stroke";
    }
    if (this.#tool(event) === "select") return this.#grab(pane, xy, event);
    if (outsideBy(toPixel(pane.viewport, xy), pane.extent) * pane.viewport.zoom > BESIDE_PICTURE_PX) return "pan";
    this.#draw(pane, xy, event);
    return "stroke";
  }

  #draw(pane, xy, event) {
    const desk = this.#desk;
    if (!desk.picking.press(pane.side, desk.view.get().tool === "point" ? "point" : "line", this.#place(pane, xy, event))) return;
    if (desk.view.get().selected.size > 0) desk.select([]);
    desk.view.set({ hovered: null });
    desk.took("drawing");
  }

  #grab(pane, xy, event) {
    const desk = this.#desk;
    const { selected } = desk.view.get();
    const hit = hitAt(desk.marks(pane.side), pane.viewport, xy, selected, desk.look.scale);
    const adds = event.shiftKey || event.ctrlKey || event.metaKey;
    if (!hit) {
      if (event.shiftKey) {
        const uv = toPixel(pane.viewport, xy);
        this.frame = { side: pane.side, from: uv, to: uv };
        return "stroke";
      }
      desk.select([]);
      return "pan";
    }
    if (adds) {
      const ids = new Set(selected);
      if (!ids.delete(hit.id)) ids.add(hit.id);
      desk.select(ids);
      return "stroke";
    }
    desk.select([hit.id], hit.index);
    const ends = desk.edits.endsOf(desk.pick(hit.id), pane.side);
    this.dragged = { id: hit.id, side: pane.side, index: hit.index, ends, from: pane.pixelAt(xy), begun: xy, moved: false };
    return "stroke";
  }

  move(pane, xy, event) {
    const desk = this.#desk;
    desk.inverted = event.altKey;
    if (!pane.extent) return;
    const uv = pane.pixelAt(xy);
    this.pointer = { side: pane.side, xy, uv, event };
    desk.cursor = desk.nudged = null;
    for (const listen of this.#listeners) listen(pane, uv);
    if (this.#yes && far(this.#yes.xy, xy, CLICK_PX)) {
      const { xy: began, event: press } = this.#yes;
      this.#yes = null;
      this.#draw(pane, began, press);
    }
    if (this.frame) this.frame.to = toPixel(pane.viewport, xy);
    else if (this.dragged) this.#drag(pane, xy, uv);
    else if (desk.picking.drawing) desk.picking.move(pane.side, this.#place(pane, xy, event));
    else this.#hover(pane, xy);
    if (desk.snaps && this.#placing(event)) desk.snapping.look(pane.side, this.#lookedAt(pane, uv));
    else desk.snapping.forget();
    pane.invalidate("live");
  }

  /** Whether an end is being placed, or would be with the next press. */
  #placing(event) {
    return this.dragged ? this.dragged.moved && this.dragged.index !== null : this.#tool(event) !== "select" && !this.frame;
  }

  /** Where the dragged end is, which need not be where it was taken hold of. */
  #lookedAt(pane, uv) {
    if (!this.dragged) return uv;
    const was = this.#desk.sides[pane.side].toPixel(this.dragged.ends[this.dragged.index]);
    return was ? [was[0] + uv[0] - this.dragged.from[0], was[1] + uv[1] - this.dragged.from[1]] : uv;
  }

  #hover(pane, xy) {
    const desk = this.#desk;
    const hit = hitAt(desk.marks(pane.side), pane.viewport, xy, desk.view.get().selected, desk.look.scale);
    if (desk.view.get().hovered !== (hit?.id ?? null)) desk.view.set({ hovered: hit?.id ?? null });
    pane.body.classList.toggle("grabs", Boolean(hit) && this.#tool(this.pointer.event) === "select");
  }

  #drag(pane, xy, uv) {
    const { dragged } = this;
    if (!dragged.moved && !far(dragged.begun, xy, DRAG_PX)) return;
    dragged.moved = true;
    const ends = this.#moved(pane, uv);
    if (ends) this.#desk.edits.show(dragged.id, dragged.side, ends);
  }

  #moved(pane, uv) {
    const { dragged } = this;
    const side = this.#desk.sides[pane.side];
    const by = [uv[0] - dragged.from[0], uv[1] - dragged.from[1]];
    const shift = (end, index) => {
      if (dragged.index !== null && dragged.index !== index) return end;
      const was = side.toPixel(end);
      if (!was) return null;
      const to = [was[0] + by[0], was[1] + by[1]];
      return side.toWorld(dragged.index === null ? to : this.aim(pane, to));
    };
    const ends = dragged.ends.map(shift);
    return ends.every(Boolean) ? ends : null;
  }

  release(pane, xy, event) {
    const desk = this.#desk;
    desk.inverted = event.altKey;
    const { dragged, frame } = this;
    if (this.#yes) {
      this.#yes = null;
      desk.accept();
    } else if (frame) {
      this.frame = null;
      desk.select(new Set([...desk.view.get().selected, ...within(desk.marks(pane.side), frame.from, frame.to)]));
    } else if (dragged) {
      const ends = dragged.moved && this.#moved(pane, pane.pixelAt(xy));
      this.dragged = null;
      if (ends) desk.edits.commit(dragged.id, dragged.side, ends);
    } else if (desk.picking.drawing) {
      desk.took(desk.picking.release(pane.side, this.#place(pane, xy, event)));
    }
    pane.invalidate("live");
  }

  /** The stroke was none: a second finger came, or the system took the pointer away. */
  cancel(pane) {
    if (this.dragged) this.#desk.edits.drop(this.dragged.id, this.dragged.side);
    this.dragged = this.frame = this.#yes = null;
    if (this.#desk.picking.drawing) this.#desk.abandon();
    pane.invalidate("live");
  }

  /** Esc during a drag puts the end back. @returns {boolean} whether one was under way */
  abandon() {
    if (!this.dragged && !this.frame) return false;
    this.cancel(this.#desk.panes[(this.dragged ?? this.frame).side]);
    return true;
  }

  leave(pane) {
    if (this.pointer?.side === pane.side) this.pointer = null;
    this.#desk.snapping.forget();
    this.#desk.view.set({ hovered: null, readout: null });
    pane.invalidate("live");
  }

  /** A double click fits unless something is begun. */
  mayFit() {
    return this.#desk.picking.idle && !this.dragged;
  }
}
