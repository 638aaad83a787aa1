/**
 * State machine of drawing a match: one side in either pane, then its partner in the other. No DOM, no network.
 *
 *     nothing ── press ──> drawing ── second end ──> open ── its partner, drawn or accepted ──> a pair
 *                             └──── Esc ────> nothing <──── Esc ────┘
 *
 * A line is made by a drag or by two clicks. A second line in the same pane replaces the first. An open side belongs to
 * the photograph that was shown when it was drawn: it waits while another is shown, and never gets a partner there.
 */

/**
 * @typedef {"scan" | "photo"} Side
 * @typedef {"line" | "point"} Kind
 * @typedef {{world: number[], uv: number[], zoom: number, time_ms: number}} PickPosition `world`: a ray (scan)
 *   or pixel (photo); `uv`: the pixel; `zoom` at that moment
 * @typedef {{side: Side, kind: Kind, ends: number[][]}} Drawn `ends` are rays (scan) or pixels (photo)
 * @typedef {{kind: Kind, scan: number[][], photo: number[][], of: string | null}} Pair `of` is the id of its photograph
 */

export const CLICK_PX = 6;
const DOUBLE_CLICK_MS = 400;
const OUT_OF_SIGHT = [-1e6, -1e6];

/** @param {Side} side @returns {Side} the other side */
export const other = (side) => (side === "scan" ? "photo" : "scan");

/**
 * @param {PickPosition} a
 * @param {PickPosition} b
 * @returns {number} CSS pixels, at the later zoom: the picture may have moved in between
 */
const distance = (a, b) => Math.hypot(a.uv[0] - b.uv[0], a.uv[1] - b.uv[1]) * b.zoom;

/** @type {(ends: (number[] | null)[] | null) => ends is number[][]} whether all ends are known */
export const isWhole = (ends) => ends !== null && ends.length > 0 && ends.every((end) => end !== null);

/** What is being drawn, the side that waits for its partner, and the partner that the pose predicts. */
export class Picking {
  /**
   * @type {{side: Side, kind: Kind, from: PickPosition, to: PickPosition, pressed: boolean, clicked: boolean} | null}
   */
  drawing = null;
  /** @type {Drawn | null} */
  open = null;
  /** @type {(number[] | null)[] | null} ends of the predicted partner, on the missing side */
  predicted = null;
  /** @type {string | null} id of the photograph to which everything here belongs */
  subject = null;
  /** @type {Map<string, Drawn>} open sides of other photographs */
  waiting = new Map();
  /** @type {{side: Side, position: PickPosition} | null} where the last stroke ended */
  #ended = null;

  /** @returns {Side | null} the side on which the partner is missing */
  get missingSide() {
    return this.open ? other(this.open.side) : null;
  }

  /** @returns {boolean} whether nothing is being drawn */
  get idle() {
    return !this.drawing && !this.open;
  }

  /** @template {string} Tool @param {Side} side @param {Tool} kind @returns {Tool | Kind} the partner is of the open side's kind, whatever the tool */
  kindFor(side, kind) {
    return this.open && this.open.side !== side ? this.open.kind : kind;
  }

  /**
   * @param {Side} side
   * @param {Kind} kind of the current tool
   * @param {PickPosition} position
   * @returns {boolean} whether a stroke begins or continues; false for the second half of a double click, and in the
   *   wrong pane
   */
  press(side, kind, position) {
    const last = this.#ended;
    this.#ended = null;
    if (last && last.side === side && position.time_ms - last.position.time_ms < DOUBLE_CLICK_MS && distance(last.position, position) < CLICK_PX) {
      return false;
    }
    if (this.drawing && this.drawing.side !== side) return false;
    if (this.drawing) {
      this.drawing.to = position;
      this.drawing.pressed = true;
    } else {
      this.drawing = { side, kind: this.kindFor(side, kind), from: position, to: position, pressed: true, clicked: false };
    }
    return true;
  }

  /** The pointer moved, pressed or not. @param {Side} side @param {PickPosition} position */
  move(side, position) {
    if (!this.drawing || this.drawing.side !== side) return false;
    this.drawing.to = position;
    if (this.drawing.kind === "point") this.drawing.from = position;
    return true;
  }

  /**
   * @param {Side} side
   * @param {PickPosition} position
   * @param {number[][] | null} snapped both ends of a line as they are to be taken, rays or pixels; null: as drawn
   * @returns {"nothing" | "drawing" | "open" | Pair} the outcome
   */
  release(side, position, snapped = null) {
    const { drawing } = this;
    if (!drawing || drawing.side !== side || !drawing.pressed) return "nothing";
    this.move(side, position);
    drawing.pressed = false;
    const far = distance(drawing.from, drawing.to) >= CLICK_PX;
    if (drawing.kind === "line" && !far) {
      // a second click at the same position cancels
      if (drawing.clicked) this.drawing = null;
      else drawing.clicked = true;
      return this.drawing ? "drawing" : "nothing";
    }
    this.drawing = null;
    this.#ended = { side, position };
    const ends = drawing.kind === "point" ? [drawing.to.world] : (snapped ?? [drawing.from.world, drawing.to.world]);
    return this.#drawn({ side, kind: drawing.kind, ends });
  }

  /** Set an end without a pointer, as a click would. @param {Side} side @param {Kind} kind @param {PickPosition} position */
  set(side, kind, position) {
    this.#ended = null;
    const result = this.press(side, kind, position) ? this.release(side, position) : "nothing";
    this.#ended = null;
    return result;
  }

  /** @param {Drawn} drawn @returns {"open" | Pair} */
  #drawn(drawn) {
    if (!this.open || this.open.side === drawn.side) {
      this.open = drawn;
      this.predicted = null;
      return "open";
    }
    return this.#paired(this.open, drawn.ends);
  }

  /** @param {Drawn} open @param {number[][]} ends @returns {Pair} */
  #paired(open, ends) {
    const { side, kind } = open;
    const [scan, photo] = side === "scan" ? [open.ends, ends] : [ends, open.ends];
    const pair = { kind, scan, photo, of: this.subject };
    this.open = null;
    this.predicted = null;
    return pair;
  }

  /**
   * Offer the predicted partner; ignored if the open side has changed since it was requested.
   * @param {Drawn} open
   * @param {(number[] | null)[] | null} ends
   */
  offer(open, ends) {
    if (this.open === open) this.predicted = ends;
  }

  /** @returns {boolean} whether the whole predicted partner is known */
  get acceptable() {
    return isWhole(this.predicted);
  }

  /** @returns {Pair | null} the pair with the predicted partner */
  accept() {
    return this.open && isWhole(this.predicted) ? this.#paired(this.open, this.predicted) : null;
  }

  /**
   * Open a first side again, in its own photograph: of a pair that was refused, or kept from an earlier page.
   * @param {Drawn} first
   * @param {string} of
   */
  reopen(first, of) {
    if (of !== this.subject) this.waiting.set(of, this.waiting.get(of) ?? first);
    else if (this.idle) this.open = first;
  }

  /**
   * Another photograph is shown: an open side waits for the return of its own, a stroke is discarded.
   * @param {string | null} photo its id
   * @returns {"kept" | "discarded" | "nothing"} what became of the drawing
   */
  turnTo(photo) {
    const { drawing, open, subject } = this;
    if (photo === subject) return "nothing";
    this.subject = photo;
    this.#ended = null;
    if (subject === null) {
      // the first photograph: what was drawn in the scan may have a partner there
      const kept = this.#waitingIn(photo);
      this.open ??= kept;
      return "nothing";
    }
    this.drawing = this.predicted = null;
    if (open) this.waiting.set(subject, open);
    this.open = this.#waitingIn(photo);
    return open ? "kept" : drawing ? "discarded" : "nothing";
  }

  /** @param {string | null} photo @returns {Drawn | null} its open side, which waits no longer */
  #waitingIn(photo) {
    if (photo === null) return null;
    const drawn = this.waiting.get(photo) ?? null;
    this.waiting.delete(photo);
    return drawn;
  }

  /** Discard the stroke, or else the open side. @returns {boolean} whether there was either */
  abandon() {
    this.#ended = null;
    if (this.drawing) this.drawing = null;
    else if (this.open) this.open = this.predicted = null;
    else return false;
    return true;
  }

  /**
   * Another view is shown on a side: the stroke there goes on from the same directions.
   * @param {Side} side
   * @param {(world: number[]) => number[] | null} toPixel in the view that is shown now; null: not in front of it
   */
  turned(side, toPixel) {
    const { drawing } = this;
    if (drawing?.side !== side) return;
    /** @param {...PickPosition} at */
    /** @param {PickPosition} at @returns {PickPosition} */
    const again = (at) => ({ ...at, uv: toPixel(at.world) ?? OUT_OF_SIGHT });
    Object.assign(drawing, { from: again(drawing.from), to: again(drawing.to) });
  }

  /** Discard all that was drawn in a scan that has been replaced. @returns {boolean} whether there was anything */
  forgetScan() {
    const drawn = [this.drawing, this.open, ...this.waiting.values()].some((each) => each?.side === "scan");
    if (this.drawing?.side === "scan") this.drawing = null;
    if (this.open?.side === "scan") this.open = null;
    this.predicted = null;
    for (const [photo, { side }] of [...this.waiting]) if (side === "scan") this.waiting.delete(photo);
    return drawn;
  }

  /** Discard the open sides of photographs that exist no longer. @param {string[]} photos ids of those that do @returns {boolean} whether there were any */
  forgetPhotosBut(photos) {
    const gone = [...this.waiting.keys()].filter((photo) => !photos.includes(photo));
    for (const photo of gone) this.waiting.delete(photo);
    return gone.length > 0;
  }

  /** @returns {[string, Drawn][]} the open sides with their photographs, as `reopen` takes them one by one */
  kept() {
    /** @type {[string, Drawn][]} */
    const own = this.open && this.subject !== null ? [[this.subject, this.open]] : [];
    return [...own, ...this.waiting];
  }

  /** @returns {Drawn[]} what is to be drawn as unfinished */
  unfinished() {
    const { drawing, open } = this;
    if (!drawing) return open ? [open] : [];
    const ends = drawing.kind === "point" ? [drawing.to.world] : [drawing.from.world, drawing.to.world];
    const stroke = { side: drawing.side, kind: drawing.kind, ends };
    return open && open.side !== drawing.side ? [open, stroke] : [stroke];
  }
}
