/** The topmost layer of a pane: strokes under way, crosshairs, and the loupe. */

import { motionAllowed } from "./pane.js";
import { drawCrosshair, drawSnap } from "./signs.js";
import { outsideBy, toPixel } from "./viewport.js";

const LOUPE_NEEDED_BELOW = 12;
const MARK_PX = 20;

/** What is drawn anew with each move of the pointer. */
export class LiveLayer {
  #desk;
  #pane;
  #painting;
  #strokes;
  #loupe;

  /** @param {{desk: any, pane: any, painting: any, strokes: any, loupe: any}} parts */
  constructor({ desk, pane, painting, strokes, loupe }) {
    this.#desk = desk;
    this.#pane = pane;
    this.#painting = painting;
    this.#strokes = strokes;
    this.#loupe = loupe;
  }

  get #side() {
    return this.#desk.sides[this.#pane.side];
  }

  /** @returns {any} the pointer, if it is in this pane */
  get #pointer() {
    const { pointer } = this.#strokes;
    return pointer?.side === this.#pane.side ? pointer : null;
  }

  /** @returns {number[] | null} the corner that an end would go to now */
  #snapped() {
    const desk = this.#desk;
    if (!this.#pointer || !desk.snaps || this.#strokes.dragged || desk.view.get().tool === "select") return null;
    return desk.snapping.near(this.#pane, this.#pointer.uv);
  }

  /** @returns {number[] | null} the end that is being moved, by the pointer or by keys */
  #movedEnd() {
    const { dragged } = this.#strokes;
    const moved = dragged ? dragged.moved && dragged.index !== null && dragged : this.#desk.nudged;
    if (!moved || moved.side !== this.#pane.side) return null;
    const pick = this.#desk.pick(moved.id);
    return pick && this.#side.toPixel(this.#desk.edits.endsOf(pick, moved.side)[moved.index]);
  }

  /** @returns {number[] | null} the pixel that the loupe shows: an end being placed, or where one would be */
  #looked() {
    const desk = this.#desk;
    const pane = this.#pane;
    const { loupe, tool } = desk.view.get();
    const pointer = this.#pointer;
    const end = pane.viewport.zoom < LOUPE_NEEDED_BELOW ? this.#movedEnd() : null;
    if (end) return end;
    if (desk.nudged) return null;
    if (!pointer) return !this.#strokes.pointer && desk.cursorShown(pane.side) && loupe ? desk.cursor.uv : null;
    if (pane.viewport.zoom >= LOUPE_NEEDED_BELOW || outsideBy(toPixel(pane.viewport, pointer.xy), pane.extent) > 0) return null;
    if (tool === "select" || this.#strokes.dragged || this.#strokes.frame) return null;
    const { drawing, wanted } = desk.picking;
    if (!drawing && wanted && wanted !== pane.side) return null;
    return drawing?.side === pane.side || wanted === pane.side || loupe ? this.#strokes.aim(pane, pointer.uv) : null;
  }

  /** @returns {number[] | null} where the line under way began, CSS pixels of the pane */
  #began() {
    const { drawing } = this.#desk.picking;
    const from = drawing?.side === this.#pane.side && drawing.kind === "line" && this.#side.toPixel(drawing.from.world);
    return from ? this.#pane.screenOf(from) : null;
  }

  /** @param {CanvasRenderingContext2D} context */
  paint(context) {
    const pane = this.#pane;
    const { look } = this.#painting;
    if (!pane.extent) {
      this.#loupe.hide();
      return;
    }
    const moves = motionAllowed();
    const pulses = this.#painting.live(context, pane.viewport, pane.size, performance.now(), moves);
    if (this.#desk.cursorShown(pane.side)) drawCrosshair(context, pane.screenOf(this.#desk.cursor.uv), look);
    const marked = this.#desk.marked(pane.side);
    if (marked) drawCrosshair(context, pane.screenOf(marked), look, MARK_PX);
    const snapped = this.#snapped();
    if (snapped) drawSnap(context, pane.screenOf(snapped), look);
    const looked = this.#looked();
    if (looked) this.#loupe.show(looked, this.#began(), snapped ? "corner" : "", look.scale);
    else this.#loupe.hide();
    if (pulses && moves) pane.invalidate("live");
  }
}
