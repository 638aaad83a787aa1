/** The top layer of a pane: unfinished strokes, crosshairs and the loupe. */

import { motionAllowed } from "./pane.js";
import { drawCrosshair, drawGhost } from "./symbols.js";
import { outsideBy, toPixel } from "./viewport.js";

const LOUPE_BELOW_ZOOM = 12;
const MARK_PX = 20;

/** The layer that is redrawn with each move of the pointer. */
export class LiveLayer {
  #controller;
  #pane;
  #painting;
  #tools;
  #loupe;

  /**
   * @param {{controller: import("./controller.js").Controller, pane: import("./pane.js").Pane,
   *          painting: import("./painting.js").Painting, tools: import("./tools.js").Tools, loupe: import("./loupe.js").Loupe}} parts
   */
  constructor({ controller, pane, painting, tools, loupe }) {
    this.#controller = controller;
    this.#pane = pane;
    this.#painting = painting;
    this.#tools = tools;
    this.#loupe = loupe;
  }

  get #side() {
    return this.#controller.sides[this.#pane.side];
  }

  /** @returns {import("./tools.js").Tools["pointer"]} the pointer, if it is in this pane */
  get #pointer() {
    const { pointer } = this.#tools;
    return pointer?.side === this.#pane.side ? pointer : null;
  }

  /** @returns {number[][] | null} where the point or line being placed would snap to now */
  #ghost() {
    return this.#pointer && this.#tools.ghost(this.#pane, this.#pointer.uv);
  }

  /** @returns {number[] | null} the end being moved, by the pointer or by keys */
  #movedEnd() {
    const { dragged } = this.#tools;
    const moved = dragged ? dragged.moved && dragged : this.#controller.nudged;
    if (!moved || moved.index === null || moved.side !== this.#pane.side) return null;
    const pick = this.#controller.pick(moved.id);
    return pick && this.#side.toPixel(this.#controller.pendingMoves.endsOf(pick, moved.side)[moved.index]);
  }

  /** @returns {number[] | null} the pixel that the loupe shows: the end being placed, or where it would be placed */
  #loupeCentre() {
    const controller = this.#controller;
    const pane = this.#pane;
    const { loupe, tool } = controller.view.get();
    const pointer = this.#pointer;
    const end = pane.viewport.zoom < LOUPE_BELOW_ZOOM ? this.#movedEnd() : null;
    if (end) return end;
    if (controller.nudged) return null;
    if (!pointer) return !this.#tools.pointer && loupe ? controller.cursorIn(pane.side) : null;
    if (!pane.extent || pane.viewport.zoom >= LOUPE_BELOW_ZOOM) return null;
    if (outsideBy(toPixel(pane.viewport, pointer.xy), pane.extent) > 0) return null;
    if (tool === "select" || this.#tools.dragged || this.#tools.frame) return null;
    const { drawing, missingSide } = controller.picking;
    if (!drawing && missingSide && missingSide !== pane.side) return null;
    return drawing?.side === pane.side || missingSide === pane.side || loupe ? this.#tools.aim(pane, pointer.uv) : null;
  }

  /** @returns {number[] | null} first end of the line being drawn, CSS pixels of the pane */
  #firstEnd() {
    const { drawing } = this.#controller.picking;
    const from = drawing?.side === this.#pane.side && drawing.kind === "line" && this.#side.toPixel(drawing.from.world);
    return from ? this.#pane.screenOf(from) : null;
  }

  /** @returns {{uv: number[], text: string}[]} the surfaces on both sides of the depth edge under the pointer */
  #surfaces() {
    const { readout } = this.#controller.view.get();
    if (readout?.side !== this.#pane.side || !readout.edge) return [];
    const { near, far, near_m, far_m } = readout.edge;
    const surface = (/** @type {number[]} */ ray, /** @type {number} */ range_m) => {
      const uv = this.#side.toPixel(ray);
      return uv ? [{ uv, text: `${range_m.toFixed(2)} m` }] : [];
    };
    return [...surface(near, near_m), ...surface(far, far_m)];
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
    const cursor = this.#controller.cursorIn(pane.side);
    if (cursor) drawCrosshair(context, pane.screenOf(cursor), look);
    const marked = this.#controller.marked(pane.side);
    if (marked) drawCrosshair(context, pane.screenOf(marked), look, MARK_PX);
    const ghost = this.#ghost();
    if (ghost) drawGhost(context, ghost.map((uv) => pane.screenOf(uv)), look);
    this.#controller.colleagues?.paint(context, pane, look);
    const centre = this.#loupeCentre();
    if (centre) this.#loupe.show(centre, this.#firstEnd(), ["", "corner", "edge"][ghost?.length ?? 0], look, this.#surfaces());
    else this.#loupe.hide();
    if (pulses && moves) pane.invalidate("live");
  }
}
