/** What is painted on each layer of a pane, and in its loupe. */

import { drawCompare } from "./compare.js";
import { drawTick } from "./prediction.js";
import * as overlay from "./match_layer.js";
import { drawPicture } from "./picture_layer.js";
import { drawCorners, drawFrame } from "./signs.js";
import { SMOOTH_BELOW, toScreen } from "./viewport.js";

const PULSE_MS = 1400;
const STILL_OUTLINE = 0.22;

/** @returns {number} strength of the outline of what waits for its partner */
export const outlineAt = (now_ms, moves) => (moves ? 0.2 + 0.16 * Math.sin((2 * Math.PI * now_ms) / PULSE_MS) : STILL_OUTLINE);

/** Painters of one pane. */
export class Painting {
  #desk;
  #side;
  #slots;
  #strokes;
  #running;
  /**
   * @param {{desk: any, side: "scan" | "photo", slots: {picture: any, compare: any}, strokes: any, running: any}} parts
   */
  constructor({ desk, side, slots, strokes, running }) {
    this.#desk = desk;
    this.#side = side;
    this.#slots = slots;
    this.#strokes = strokes;
    this.#running = running;
  }

  /** @returns {ReturnType<typeof import("./colors.js").readLook>} */
  get look() {
    return this.#desk.look;
  }

  get #sideOf() {
    return this.#desk.sides[this.#side];
  }

  picture(context, viewport, size) {
    const { picture } = this.#slots.picture;
    const { extent } = this.#sideOf;
    if (picture && extent) drawPicture(context, viewport, size, picture, extent, viewport.zoom < SMOOTH_BELOW);
  }

  /**
   * The registered scan over the photograph; `swipe_x` where the swipe stands in this picture.
   * @returns {boolean} whether there is any
   */
  compare(context, viewport, size, swipe_x) {
    const picture = this.#slots.compare?.picture;
    const { extent } = this.#sideOf;
    if (!picture || !extent) return false;
    const { overlay: mode, blend } = this.#desk.view.get().photo;
    drawCompare(context, viewport, size, picture, extent, { overlay: mode, blend, swipe_x }, viewport.zoom < SMOOTH_BELOW);
    return true;
  }

  /** Matches at rest. */
  matches(context, viewport, size) {
    const desk = this.#desk;
    if (!this.#sideOf.extent) return;
    if (desk.showsCorners) drawCorners(context, viewport, size, desk.corners(this.#side), this.look);
    const held = this.#strokes.dragged?.id;
    const residuals = !this.#running.predicted;
    overlay.drawMatches(context, viewport, size, desk.marks(this.#side).filter(({ id }) => id !== held), this.look, { residuals });
  }

  /** What moves: highlights, strokes, offers, the solver's steps. @returns {boolean} whether something pulses */
  live(context, viewport, size, now_ms, moves) {
    const desk = this.#desk;
    if (!this.#sideOf.extent) return false;
    const { hovered, selected, end } = desk.view.get();
    const [side, look] = [this.#side, this.look];
    const marks = desk.marks(side);
    const { predicted } = this.#running;
    if (side === "photo" && predicted) overlay.drawPredictions(context, viewport, size, marks, predicted, look);
    for (const mark of marks) {
      const held = this.#strokes.dragged?.id === mark.id;
      if (!held && !selected.has(mark.id) && mark.id !== hovered) continue;
      const shownEnd = end?.side === side && selected.size === 1 && selected.has(mark.id) ? end.index : null;
      overlay.drawMark(context, viewport, mark, look, { hovered: mark.id === hovered, selected: selected.has(mark.id), end: shownEnd });
    }
    const pulses = this.#unfinished(context, viewport, now_ms, moves);
    const { frame } = this.#strokes;
    if (frame?.side === side) {
      drawFrame(context, toScreen(viewport, frame.from), toScreen(viewport, frame.to), look);
    }
    return pulses;
  }

  #unfinished(context, viewport, now_ms, moves) {
    const desk = this.#desk;
    const { picking } = desk;
    const [side, look] = [this.#side, this.look];
    const colour = look.matches[desk.store.picksOf().length % look.matches.length];
    let pulses = false;
    for (const { [side]: ends } of desk.sent) overlay.drawOpen(context, viewport, this.#sideOf.placed(ends), look, { colour });
    for (const drawn of picking.unfinished()) {
      if (drawn.side !== side) continue;
      const waits = drawn === picking.open;
      overlay.drawOpen(context, viewport, this.#sideOf.placed(drawn.ends), look, { colour, outline: waits ? outlineAt(now_ms, moves) : 0 });
      if (waits) this.#samples(context, viewport, drawn);
      pulses ||= waits;
    }
    const offered = this.#strokes.offered(side);
    if (offered && !picking.drawing) {
      overlay.drawOpen(context, viewport, offered, look, { colour, offered: true });
      drawTick(context, offered, viewport, look, colour);
    }
    return pulses;
  }

  /** Samples of the open line: whether it lies where the scan has ranges. */
  #samples(context, viewport, drawn) {
    const told = this.#desk.openSamples;
    if (told?.open !== drawn || this.#side !== "scan") return;
    const samples = told.samples.map(([ray, has_range]) => ({ uv: this.#sideOf.toPixel(ray), has_range })).filter(({ uv }) => uv);
    overlay.drawSamples(context, viewport, samples, this.look, this.look.ink);
  }
}
