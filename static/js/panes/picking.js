/**
 * Drawing a match: one side in either pane, its partner in the other. A state machine without page or network; the rest
 * tells it where the pointer goes and asks it what is drawn.
 *
 *     nothing ── press ──> drawing ── second end ──> open ── its partner, drawn or accepted ──> a pair
 *                             └──── Esc ────> nothing <──── Esc ────┘
 *
 * Press, drag and release make a line, and so do two clicks. A line that is drawn while its partner is wanted takes the
 * open one's place where it is drawn in the same pane.
 */

/**
 * @typedef {"scan" | "photo"} Side
 * @typedef {"line" | "point"} Kind
 * @typedef {{world: number[], uv: readonly number[], zoom: number, time_ms: number}} Place `world`: a ray (scan) or pixel
 *   (photo); `uv`: the pixel, at the zoom of that moment
 * @typedef {{side: Side, kind: Kind, ends: number[][]}} Drawn `ends` are rays (scan) or pixels (photo)
 * @typedef {{kind: Kind, scan: number[][], photo: number[][]}} Pair
 */

export const CLICK_PX = 6;
const DOUBLE_CLICK_MS = 400;

/** @returns {Side} */
export const other = (side) => (side === "scan" ? "photo" : "scan");

/** @returns {number} CSS pixels, at the later place's zoom: the picture may have been moved in between */
const distance = (a, b) => Math.hypot(a.uv[0] - b.uv[0], a.uv[1] - b.uv[1]) * b.zoom;

/** What is being drawn, what waits for its partner, and what the pose offers as that. */
export class Picking {
  /** @type {{side: Side, kind: Kind, from: Place, to: Place, pressed: boolean, clicked: boolean} | null} */
  drawing = null;
  /** @type {Drawn | null} */
  open = null;
  /** @type {(number[] | null)[] | null} ends of the predicted partner, of the side that is wanted */
  predicted = null;
  #ended = null;

  /** @returns {Side | null} the pane where the partner is wanted */
  get wanted() {
    return this.open && other(this.open.side);
  }

  /** @returns {boolean} whether nothing is begun */
  get idle() {
    return !this.drawing && !this.open;
  }

  /** @returns {Kind} the partner is of the kind of the open one, whatever tool is in hand */
  #kindFor(side, kind) {
    return this.open && this.open.side !== side ? this.open.kind : kind;
  }

  /**
   * @param {Side} side
   * @param {Kind} kind of the tool in hand
   * @param {Place} place
   * @returns {boolean} whether it begins or goes on; false for the second half of a double click, and in the wrong pane
   */
  press(side, kind, place) {
    const last = this.#ended;
    this.#ended = null;
    if (last && last.side === side && place.time_ms - last.place.time_ms < DOUBLE_CLICK_MS && distance(last.place, place) < CLICK_PX) {
      return false;
    }
    if (this.drawing && this.drawing.side !== side) return false;
    if (this.drawing) {
      this.drawing.to = place;
      this.drawing.pressed = true;
    } else {
      this.drawing = { side, kind: this.#kindFor(side, kind), from: place, to: place, pressed: true, clicked: false };
    }
    return true;
  }

  /** The pointer moved, pressed or not. */
  move(side, place) {
    if (!this.drawing || this.drawing.side !== side) return false;
    this.drawing.to = place;
    if (this.drawing.kind === "point") this.drawing.from = place;
    return true;
  }

  /**
   * @returns {"nothing" | "drawing" | "open" | Pair} what has come of it
   */
  release(side, place) {
    const { drawing } = this;
    if (!drawing || drawing.side !== side || !drawing.pressed) return "nothing";
    this.move(side, place);
    drawing.pressed = false;
    const far = distance(drawing.from, drawing.to) >= CLICK_PX;
    if (drawing.kind === "line" && !far) {
      // The second click on the same place is a double click, or a change of mind.
      if (drawing.clicked) this.drawing = null;
      else drawing.clicked = true;
      return this.drawing ? "drawing" : "nothing";
    }
    this.drawing = null;
    this.#ended = { side, place };
    const ends = drawing.kind === "point" ? [drawing.to.world] : [drawing.from.world, drawing.to.world];
    return this.#drawn({ side, kind: drawing.kind, ends });
  }

  /** Set an end without a pointer: the same as a click there. */
  set(side, kind, place) {
    this.#ended = null;
    const result = this.press(side, kind, place) ? this.release(side, place) : "nothing";
    this.#ended = null;
    return result;
  }

  /** @returns {"open" | Pair} */
  #drawn(drawn) {
    if (!this.open || this.open.side === drawn.side) {
      this.open = drawn;
      this.predicted = null;
      return "open";
    }
    return this.#paired(drawn.ends);
  }

  /** @returns {Pair} */
  #paired(ends) {
    const { side, kind } = this.open;
    const pair = { kind, [side]: this.open.ends, [other(side)]: ends };
    this.open = null;
    this.predicted = null;
    return pair;
  }

  /** Offer the partner that the pose predicts; forgotten if the open one has changed since it was asked. */
  offer(open, ends) {
    if (this.open === open) this.predicted = ends;
  }

  /** @returns {boolean} whether the whole predicted partner is known */
  get acceptable() {
    return this.predicted !== null && this.predicted.length > 0 && this.predicted.every((end) => end !== null);
  }

  /** @returns {Pair | null} the pair with the predicted partner */
  accept() {
    return this.open && this.acceptable ? this.#paired(this.predicted) : null;
  }

  /** Take a pair back that was refused: its first side is open again. */
  reopen(first) {
    if (this.idle) this.open = first;
  }

  /** @returns {boolean} whether there was something to abandon; the stroke goes first, then what is open */
  abandon() {
    this.#ended = null;
    if (this.drawing) this.drawing = null;
    else if (this.open) this.open = this.predicted = null;
    else return false;
    return true;
  }

  /** Drop the stroke under way on a side, and nothing else. */
  dropStroke(side) {
    if (this.drawing?.side === side) this.drawing = null;
  }

  /** Drop all that was drawn on a side: its scan or photograph is no longer shown. */
  forget(side) {
    if (this.drawing?.side === side) this.drawing = null;
    if (this.open?.side === side) this.open = this.predicted = null;
    else this.predicted = null;
  }

  /** @returns {Drawn[]} all that is to be drawn as unfinished */
  unfinished() {
    const { drawing, open } = this;
    if (!drawing) return open ? [open] : [];
    const ends = drawing.kind === "point" ? [drawing.to.world] : [drawing.from.world, drawing.to.world];
    const stroke = { side: drawing.side, kind: drawing.kind, ends };
    return open && open.side !== drawing.side ? [open, stroke] : [stroke];
  }
}
