/** The state that the parts of the two image panes share, and the edits that they send to the workbench. */

import { measurementsNow } from "../state/measuring.js";
import { newRangesHere } from "../state/smoothing.js";
import { messageOf } from "../ui/faults.js";
import { readLook } from "./colors.js";
import { marksOf } from "./marks.js";
import { measuredMarks } from "./measured_layer.js";
import { Measuring } from "./measuring.js";
import { hintOf } from "./notes.js";
import { PendingMoves } from "./pending_moves.js";
import { other, Picking } from "./picking.js";
import { PhotoSide, ScanSide } from "./sides.js";
import { smoothedMarks } from "./smoothing_layer.js";
import { Snapping } from "./snapping.js";
import { centredOn } from "./viewport.js";

/**
 * @typedef {import("./picking.js").Side} Side
 * @typedef {import("./picking.js").Drawn} Drawn
 * @typedef {import("./pane.js").Layer} Layer
 * @typedef {import("../net/store.js").Pick} Pick
 * @typedef {import("../net/requests.js").Commands} Commands
 */

/** A pair that was sent stays drawn until its slice arrives, this long at most. */
const SENT_SHOWN_MS = 2000;
const MARK_SHOWN_MS = 6000;
/** @type {number[][]} */
const NO_TIES = []; // always the same, so that nothing seems to have changed

/** Controller of the two image panes. */
export class Controller {
  /** @type {Record<"scan" | "photo", import("./pane.js").Pane>} */
  panes = /** @type {any} */ ({}); // each sets itself when it is mounted
  picking = new Picking();
  /** @type {"scan" | "photo"} the pane used last */
  active = "scan";
  /** @type {(import("./picking.js").Pair & {id: string | null})[]} pairs sent but not yet shown by the workbench */
  sent = [];
  /** @type {{side: "scan" | "photo", uv: number[], moved: boolean} | null} the keyboard crosshair */
  cursor = null;
  /** @type {{open: import("./picking.js").Drawn, samples: [number[], boolean][]} | null} samples of the open line */
  openSamples = null;
  /** @type {{side: "scan" | "photo", id: string, index: number} | null} the end being moved by keys */
  nudged = null;
  /** Called when the answer to a snap question has arrived. */
  onSnapped = () => {};
  /** Called after each change of what is being drawn. */
  onPickingChanged = () => {};
  /** Shift is held, which suspends snapping. */
  suspended = false;
  /** @type {import("./colleagues.js").Colleagues | null} other people in the pictures */
  colleagues = null;
  /** @type {Partial<Record<Side, import("./marks.js").Mark[]>>} */
  #marks = {};
  /** @type {Partial<Record<Side, ReturnType<typeof measuredMarks>>>} */
  #measured = {};
  /** @type {ReturnType<typeof smoothedMarks> | null} */
  #smoothed = null;
  /** @type {Map<Side, number[]>} */
  #marked = new Map();
  #markTimer = 0;
  /** @type {Partial<Record<Side, number[][]>>} */
  #corners = {};

  /**
   * @param {{store: import("../net/store.js").Store, view: typeof import("../state/view.js").view,
   *          ask: typeof import("../net/connection.js").ask}} page
   */
  constructor({ store, view, ask }) {
    this.look = readLook();
    addEventListener("resize", () => Object.assign(this.look, readLook()));
    this.store = store;
    this.view = view;
    this.ask = ask;
    this.sides = { scan: new ScanSide(store, view), photo: new PhotoSide(store, view) };
    this.measuring = new Measuring(this);
    this.pendingMoves = new PendingMoves(
      (photo, id, side, ends) => this.#sendEnds(photo, id, side, ends),
      () => store.shown(),
      () => this.changed(),
    );
    this.snapping = new Snapping(
      (question) => ask("snap", question),
      (side) => ({ photo: store.shown() ?? undefined, view: side === "scan" ? this.sides.scan.index : undefined }),
      () => {
        this.onSnapped();
        this.redraw("live");
      },
    );
  }

  /** @param {string} photo @param {string} id @param {Side} side @param {number[][]} ends */
  async #sendEnds(photo, id, side, ends) {
    try {
      await this.ask("set_pick", { photo, pick: id, [side === "scan" ? "scan" : "photo_uv"]: ends });
    } catch (error) {
      this.report(error);
      throw error;
    }
  }

  /**
   * Send an edit of the shown photograph; a refusal is reported.
   * @template {import("../net/requests.js").OfPhoto} Name
   * @param {Name} what
   * @param {Omit<Commands[Name], "photo">} args
   * @returns {Promise<any>} the answer, or null if it was refused
   */
  async edit(what, args) {
    try {
      return await this.ask(what, /** @type {Commands[Name]} */ (/** @type {unknown} */ ({ photo: this.store.shown(), ...args })));
    } catch (error) {
      this.report(error);
      return null;
    }
  }

  /** Show an error as a notice. @param {unknown} error */
  report(error) {
    this.store.take({ event: "notice", level: "bad", text: messageOf(error) });
  }

  /** Recompute the marks and redraw, after the matches or views have changed. */
  changed() {
    this.#marks = {};
    this.#measured = {};
    this.#smoothed = null;
    this.#corners = {};
    this.redraw("matches", "live");
  }

  /** Redraw layers of both panes. @param {...Layer} layers */
  redraw(...layers) {
    for (const pane of Object.values(this.panes)) pane.invalidate(...layers);
  }

  /** @param {Side} side @returns {import("./marks.js").Mark[]} marks of the shown photograph's matches */
  marks(side) {
    const { store } = this;
    this.#marks[side] ??= this.sides[side].extent
      ? marksOf(side, store.picksOf(), store.judgedOf(), this.sides[side].lens, (pick) => this.pendingMoves.endsOf(pick, side))
      : [];
    return this.#marks[side];
  }

  /** @param {Side} side @returns {ReturnType<typeof measuredMarks>} measurements, as they are drawn */
  measured(side) {
    this.#measured[side] ??= this.sides[side].extent ? measuredMarks(measurementsNow(), this.sides[side]) : [];
    return this.#measured[side];
  }

  /** @returns {ReturnType<typeof smoothedMarks>} ranges of the scan that would be replaced, as they are drawn */
  get smoothed() {
    this.#smoothed ??= this.sides.scan.extent ? smoothedMarks(newRangesHere(), this.sides.scan) : [];
    return this.#smoothed;
  }

  /** @param {Side} side @returns {number[][]} detected corners, in pixels */
  corners(side) {
    this.#corners[side] ??= (this.store.get(`corners:${this.store.shown()}`)?.[side] ?? [])
      .map((world) => this.sides[side].toPixel(world))
      .filter((uv) => uv !== null);
    return this.#corners[side];
  }

  /** @returns {number[][]} ties of the photograph with others; they are shown while the operator works on all of them */
  get ties() {
    return this.view.get().step === "stations" ? this.store.get(`ties:${this.store.shown()}`) ?? NO_TIES : NO_TIES;
  }

  /** @returns {boolean} whether detected corners are shown */
  get showsCorners() {
    return this.view.get().corners !== false;
  }

  /** @param {string} id @returns {Pick | null} a pick of the shown photograph by its id */
  pick(id) {
    return this.store.picksOf().find((pick) => pick.id === id) ?? null;
  }

  /** @returns {boolean} whether lines snap to edges and points to corners now */
  get snaps() {
    return this.view.get().snap && !this.suspended;
  }

  /** @returns {"line" | "point" | "select" | "measure"} the tool; a page that may only look does not draw */
  get tool() {
    return this.store.readOnly ? "select" : this.view.get().tool;
  }

  /** @returns {boolean} whether a pose is shown */
  get posed() {
    return this.store.stageOf() !== null;
  }

  /**
   * Select matches by id, and optionally an end by its index, on the side used last.
   * @param {Iterable<string>} ids
   * @param {number | null} [index]
   */
  select(ids, index = null) {
    this.view.set({ selected: new Set(ids), end: index === null ? null : { side: this.active, index } });
  }

  /** @returns {string | null} the id of the only selected match */
  get chosen() {
    const { selected } = this.view.get();
    return selected.size === 1 ? [...selected][0] : null;
  }

  /** @param {Side} side @param {number[]} uv @returns {import("./picking.js").PickPosition} */
  positionAt(side, uv, time_ms = performance.now()) {
    return { world: this.sides[side].toWorld(uv), uv, zoom: this.panes[side].viewport.zoom, time_ms };
  }

  /** Move the keyboard crosshair to a pixel; a line being drawn follows it. @param {Side} side @param {number[]} uv */
  moveCursor(side, uv) {
    const pane = this.panes[side];
    this.cursor = { side, uv, moved: true };
    this.picking.move(side, this.positionAt(side, uv));
    if (pane.screenOf(uv).some((at, axis) => at < 0 || at > pane.size[axis])) pane.place(centredOn(uv, pane.viewport.zoom, pane.size), "hand");
    this.redraw("live");
  }

  /** @param {Side} side @returns {number[] | null} where the keyboard crosshair is shown in a pane */
  cursorIn(side) {
    return this.cursor?.side === side && document.activeElement === this.panes[side].body ? this.cursor.uv : null;
  }

  /** Mark a pixel for some seconds. @param {Side} side @param {number[]} uv */
  mark(side, uv) {
    this.#marked.set(side, uv);
    clearTimeout(this.#markTimer);
    this.#markTimer = setTimeout(() => {
      this.#marked.clear();
      this.redraw("live");
    }, MARK_SHOWN_MS);
    this.redraw("live");
  }

  /** @param {Side} side @returns {number[] | undefined} the marked pixel */
  marked(side) {
    return this.#marked.get(side);
  }

  /**
   * Handle the outcome of a stroke: a complete pair is sent, a first side gets its samples and prediction.
   * @param {ReturnType<import("./picking.js").Picking["release"]>} outcome
   */
  handle(outcome) {
    if (outcome === "open") this.#opened();
    else if (typeof outcome === "object" && outcome) this.#send(outcome);
    this.hint();
    this.onPickingChanged();
    this.redraw("live");
  }

  /** Update the hint in the status bar. */
  hint() {
    const ready = Boolean(this.sides.scan.extent && this.sides.photo.extent);
    const hint = this.tool === "measure" && this.sides.scan.extent
      ? this.measuring.hint
      : ready ? hintOf(this.picking, this.tool, { readOnly: this.store.readOnly, chosen: this.chosen !== null }) : null;
    if (hint !== this.view.get().hint) this.view.set({ hint });
  }

  /** Discard what is being drawn. @returns {boolean} whether there was anything */
  abandon() {
    const any = this.picking.abandon();
    if (any) this.handle("nothing");
    return any;
  }

  /** Accept the predicted partner. @returns {boolean} whether there was one */
  accept() {
    const pair = this.picking.accept();
    if (pair) this.handle(pair);
    return pair !== null;
  }

  /**
   * Turn to the shown scan and photograph: what was drawn stays with its own, and is never matched across.
   * @param {boolean} scanReplaced
   */
  turnTo(scanReplaced) {
    const { picking, store } = this;
    this.pendingMoves.dropUnsent();
    const name = store.photo(picking.subject)?.name;
    const drawing = picking.turnTo(store.shown());
    const photos = store.photos().map(({ id }) => id);
    const lost = picking.forgetPhotosBut(photos);
    this.measuring.forgetPhotosBut(photos);
    if (scanReplaced && picking.forgetScan()) this.notify("The unfinished match was discarded: another scan was opened.");
    else if (lost) this.notify("The unfinished match was discarded: its photograph was removed.");
    else if (drawing === "kept") this.notify(`The unfinished match stays with ${name}: show that photograph to complete it.`);
    else if (drawing === "discarded") this.notify("The unfinished stroke was discarded: another photograph is shown.");
    if (picking.open) this.#opened();
  }

  /** Show a warning. @param {string} text */
  notify(text) {
    this.store.take({ event: "notice", level: "warn", text });
  }

  /** Request the samples of a new first side, and the partner that the pose predicts for it. */
  #opened() {
    const { open } = this.picking;
    this.openSamples = null;
    if (!open) return;
    if (open.side === "scan" && open.kind === "line") this.#sample(open);
    if (this.posed) this.#predict(open);
  }

  /** @param {Drawn} open */
  async #sample(open) {
    try {
      const { scan_samples: samples } = await this.ask("sample_line", { scan: open.ends });
      this.openSamples = { open, samples };
    } catch {
      return; // the finished match shows its samples, too
    }
    this.redraw("live");
  }

  /** @param {Drawn} open */
  async #predict(open) {
    const photo = this.picking.subject;
    if (photo === null) return;
    const given = { [open.side === "scan" ? "scan" : "photo_uv"]: open.ends };
    try {
      const answer = await this.ask("predict", { photo, side: open.side, ...given });
      this.picking.offer(open, answer[other(open.side) === "scan" ? "scan" : "photo_uv"]);
    } catch {
      return; // without a prediction the partner is drawn by hand
    }
    this.handle("nothing");
  }

  /** @param {import("./picking.js").Pair} pair */
  async #send(pair) {
    const first = this.active === "scan" ? "photo" : "scan";
    const { of } = pair;
    if (of === null) return; // a pair has a side in a photograph
    /** @type {Controller["sent"][number]} */
    const entry = { ...pair, id: null };
    this.sent.push(entry);
    const forget = () => {
      this.sent = this.sent.filter((each) => each !== entry);
      this.redraw("live");
    };
    try {
      const { pick } = await this.ask("add_pick", {
        photo: of, kind: pair.kind, scan: pair.scan, photo_uv: pair.photo, station: this.store.photo(of)?.station ?? "",
      });
      /** @type {string} */
      const id = typeof pick === "object" && pick ? pick.id : pick;
      entry.id = id;
      if (this.picking.idle && of === this.store.shown()) this.select([id], pair[this.active].length - 1);
      this.forgetArrived();
      setTimeout(forget, SENT_SHOWN_MS);
    } catch (error) {
      forget();
      this.report(error);
      this.picking.reopen({ side: first, kind: pair.kind, ends: pair[first] }, of);
      this.handle("nothing");
    }
  }

  /** @returns {(import("./picking.js").Pair & {id: string | null})[]} sent pairs of the shown photograph */
  get sentHere() {
    return this.sent.filter(({ of }) => of === this.store.shown());
  }

  /** Forget sent pairs that the workbench shows by now. */
  forgetArrived() {
    const shown = this.store.shown();
    this.sent = this.sent.filter(({ id, of }) => id === null || (of === shown && !this.pick(id)));
  }
}
