/** Painting of the layers of a pane, and of its loupe. */

import { drawCompare } from "./compare.js";
import * as overlay from "./match_layer.js";
import { drawMeasured, drawPicked } from "./measured_layer.js";
import { drawSmoothed } from "./smoothing_layer.js";
import { drawPicture } from "./picture_layer.js";
import { drawTick } from "./prediction.js";
import { drawCorners, drawFrame, drawTies } from "./symbols.js";
import { SMOOTH_BELOW, toScreen } from "./viewport.js";

/**
 * @typedef {import("./viewport.js").Viewport} Viewport
 * @typedef {import("./picking.js").Drawn} Drawn
 */

const PULSE_MS = 1400;
const STILL_OUTLINE = 0.22;

/** @param {Viewport} a @param {Viewport} b */
const isSame = (a, b) => a.zoom === b.zoom && a.x === b.x && a.y === b.y;
/** @type {number[][]} */
const NOTHING = [];

/**
 * @param {number} now_ms
 * @param {boolean} moves
 * @returns {number} opacity of the outline around a side that waits for its partner
 */
export const outlineAt = (now_ms, moves) => (moves ? 0.2 + 0.16 * Math.sin((2 * Math.PI * now_ms) / PULSE_MS) : STILL_OUTLINE);

/**
 * @typedef {{viewport: import("./viewport.js").Viewport, size: readonly number[],
 *   look: import("./colors.js").Look, corners: number[][], ties: number[][], residuals: boolean,
 *   laidOut: overlay.LaidOut[]}} MatchesShown
 */

/** @typedef {{picture: import("./picture_layer.js").Slot, compare: import("./picture_layer.js").Slot | null}} Slots of a pane */

/** Painting of one pane. */
export class Painting {
  #controller;
  #side;
  #slots;
  #tools;
  #preview;
  /** @type {MatchesShown | null} the layer of matches as it was laid out last */
  #shown = null;
  /**
   * @param {{controller: import("./controller.js").Controller, side: "scan" | "photo", slots: Slots,
   *          tools: import("./tools.js").Tools, preview: import("./simplex_preview.js").SimplexPreview}} parts
   */
  constructor({ controller, side, slots, tools, preview }) {
    this.#controller = controller;
    this.#side = side;
    this.#slots = slots;
    this.#tools = tools;
    this.#preview = preview;
  }

  /** @returns {import("./colors.js").Look} */
  get look() {
    return this.#controller.look;
  }

  get #sideOf() {
    return this.#controller.sides[this.#side];
  }

  /**
   * The picture; `viewer`: the pane or its loupe, which see different parts of it.
   * @param {CanvasRenderingContext2D} context
   * @param {Viewport} viewport
   * @param {readonly number[]} size
   */
  picture(context, viewport, size, viewer = "pane") {
    const { shown, finer } = this.#slots.picture;
    const { extent } = this.#sideOf;
    if (!shown || !extent) return;
    drawPicture(context, viewport, size, shown, extent, viewport.zoom < SMOOTH_BELOW, finer && { parts: finer, viewer });
  }

  /**
   * The registered scan over the photograph; `swipe_x`: position of the swipe in this picture.
   * @param {CanvasRenderingContext2D} context
   * @param {Viewport} viewport
   * @param {readonly number[]} size
   * @param {number} swipe_x
   * @returns {boolean} whether anything was drawn
   */
  compare(context, viewport, size, swipe_x) {
    const picture = this.#slots.compare?.shown;
    const { extent } = this.#sideOf;
    if (!picture || !extent) return false;
    const { placement, photo: { overlay, blend } } = this.#controller.view.get();
    const mode = placement && overlay === "none" ? "blend" : overlay;
    drawCompare(context, viewport, size, picture, extent, { overlay: mode, blend, swipe_x }, viewport.zoom < SMOOTH_BELOW);
    return true;
  }

  /**
   * @param {Viewport} viewport
   * @param {readonly number[]} size
   * @returns {MatchesShown} what the layer of matches consists of: they are laid out, without the one being dragged
   */
  #matchesIn(viewport, size) {
    const controller = this.#controller;
    const { look } = this;
    const draggedId = this.#tools.dragged?.id;
    const { marks: wanted, placement } = controller.view.get();
    const covers = this.#side === "photo" && placement !== null; // they belong to another pose than the preview
    const shown = this.#sideOf.extent && wanted !== false && !covers;
    const marks = shown ? controller.marks(this.#side).filter(({ id }) => id !== draggedId) : [];
    return {
      viewport: { ...viewport }, size, look,
      corners: this.#sideOf.extent && controller.showsCorners ? controller.corners(this.#side) : [],
      ties: this.#side === "photo" && shown ? controller.ties : NOTHING,
      residuals: !this.#preview.predicted,
      laidOut: overlay.layOut(viewport, size, marks, look),
    };
  }

  /**
   * Look at the matches again, for `matches` of the pane.
   * @param {Viewport} viewport
   * @param {readonly number[]} size
   * @returns {number[][] | null} the places, CSS pixels, that look different from the time before; null: any
   */
  changedMatches(viewport, size) {
    const [before, now] = [this.#shown, this.#matchesIn(viewport, size)];
    this.#shown = now;
    if (before === null || !isSame(before.viewport, viewport)) return null;
    if (before.look !== now.look || before.residuals !== now.residuals || before.ties !== now.ties) return null;
    if (before.size[0] !== size[0] || before.size[1] !== size[1] || before.corners.length !== now.corners.length) return null;
    if (before.corners.some(([u, v], k) => u !== now.corners[k][0] || v !== now.corners[k][1])) return null;
    return overlay.changedBoxes(before.laidOut, now.laidOut, now.look);
  }

  /**
   * The matches that `changedMatches` has looked at; `boxes`: the places that are drawn; null: all.
   * @param {CanvasRenderingContext2D} context
   * @param {number[][] | null | undefined} boxes
   */
  matches(context, boxes) {
    if (this.#shown) this.#drawMatches(context, this.#shown, boxes ?? null);
  }

  /**
   * The matches as another part of the picture shows them.
   * @param {CanvasRenderingContext2D} context
   * @param {Viewport} viewport
   * @param {readonly number[]} size
   */
  matchesIn(context, viewport, size) {
    this.#drawMatches(context, this.#matchesIn(viewport, size));
  }

  /** @param {CanvasRenderingContext2D} context @param {MatchesShown} shown @param {number[][] | null} [boxes] */
  #drawMatches(context, { viewport, size, look, corners, ties, residuals, laidOut }, boxes = null) {
    if (ties.length) drawTies(context, viewport, size, ties, look);
    if (corners.length) drawCorners(context, viewport, size, corners, look);
    overlay.drawMatches(context, laidOut, look, { residuals, boxes });
  }

  /**
   * What moves: highlights, unfinished strokes, predictions, the solver's steps.
   * @param {CanvasRenderingContext2D} context
   * @param {Viewport} viewport
   * @param {readonly number[]} size
   * @param {number} now_ms
   * @param {boolean} moves
   * @returns {boolean} whether any pulses
   */
  live(context, viewport, size, now_ms, moves) {
    const controller = this.#controller;
    if (!this.#sideOf.extent) return false;
    const { hovered, selected, end } = controller.view.get();
    const [side, look] = [this.#side, this.look];
    const marks = controller.marks(side);
    this.#measurements(context, viewport);
    if (side === "scan" && controller.smoothed.length) {
      const { smoothed, smooth_edges: edges } = controller.view.get();
      drawSmoothed(context, viewport, controller.smoothed, smoothed, edges, look);
    }
    const { predicted } = this.#preview;
    if (side === "photo" && predicted) overlay.drawPredictions(context, viewport, size, marks, predicted, look);
    for (const mark of marks) {
      const dragged = this.#tools.dragged?.id === mark.id;
      if (!dragged && !selected.has(mark.id) && mark.id !== hovered) continue;
      const shownEnd = end?.side === side && selected.size === 1 && selected.has(mark.id) ? end.index : null;
      overlay.drawMark(context, viewport, mark, look, { hovered: mark.id === hovered, selected: selected.has(mark.id), end: shownEnd });
    }
    const pulses = this.#unfinished(context, viewport, now_ms, moves);
    const { frame } = this.#tools;
    if (frame?.side === side) {
      drawFrame(context, toScreen(viewport, frame.from), toScreen(viewport, frame.to), look);
    }
    return pulses;
  }

  /** @param {CanvasRenderingContext2D} context @param {Viewport} viewport */
  #measurements(context, viewport) {
    const controller = this.#controller;
    const { marks, measurement, placement } = controller.view.get();
    const [side, look, measures] = [this.#side, this.look, controller.tool === "measure"];
    const covers = side === "photo" && placement !== null;
    if ((marks !== false || measures) && !covers) drawMeasured(context, viewport, controller.measured(side), measurement, look);
    if (!measures) return;
    const { pointer } = this.#tools;
    const runs = controller.measuring.runs(side).map((run) => run.map((world) => this.#sideOf.toPixel(world)));
    const next = pointer?.side === side && controller.measuring.endsIn(side) ? pointer.uv : null;
    drawPicked(context, viewport, runs, next, look);
  }

  /** @param {CanvasRenderingContext2D} context @param {Viewport} viewport @param {number} now_ms @param {boolean} moves */
  #unfinished(context, viewport, now_ms, moves) {
    const controller = this.#controller;
    const { picking } = controller;
    const [side, look] = [this.#side, this.look];
    const colour = look.matches[controller.store.picksOf().length % look.matches.length];
    let pulses = false;
    for (const { [side]: ends } of controller.sentHere) overlay.drawOpen(context, viewport, this.#sideOf.placed(ends), look, { colour });
    for (const drawn of picking.unfinished()) {
      if (drawn.side !== side) continue;
      const waits = drawn === picking.open;
      overlay.drawOpen(context, viewport, this.#sideOf.placed(drawn.ends), look, { colour, outline: waits ? outlineAt(now_ms, moves) : 0 });
      if (waits) this.#samples(context, viewport, drawn);
      pulses ||= waits;
    }
    const offered = this.#tools.offered(side);
    if (offered && !picking.drawing) {
      overlay.drawOpen(context, viewport, offered, look, { colour, offered: true });
      drawTick(context, offered, viewport, look, colour);
    }
    return pulses;
  }

  /**
   * Draw the samples of the open line, which show where the scan has ranges.
   * @param {CanvasRenderingContext2D} context
   * @param {Viewport} viewport
   * @param {Drawn} drawn
   */
  #samples(context, viewport, drawn) {
    const known = this.#controller.openSamples;
    if (known?.open !== drawn || this.#side !== "scan") return;
    const placed = known.samples.flatMap(([ray, has_range]) => {
      const uv = this.#sideOf.toPixel(ray);
      return uv ? [{ at: toScreen(viewport, uv), has_range }] : [];
    });
    overlay.drawSamples(context, placed, this.look, this.look.ink);
  }
}
