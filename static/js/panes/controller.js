/** What the parts of the two panes share: the sides, the panes, what is being drawn and moved, and who is told. */

import { Edits } from "./pending_moves.js";
import { hintOf } from "./hints.js";
import { readLook } from "./colors.js";
import { marksOf } from "./marks.js";
import { other, Picking } from "./picking.js";
import { PhotoSide, ScanSide } from "./sides.js";
import { Snapping } from "./snapping.js";
import { centredOn } from "./viewport.js";

/** A pair that was sent stays drawn until the workbench shows it. */
const SENT_LINGERS_MS = 2000;
const MARKED_MS = 6000;

/** The desk on which both pictures lie. */
export class Desk {
  /** @type {Record<"scan" | "photo", import("./pane.js").Pane>} */
  panes = {};
  picking = new Picking();
  /** @type {"scan" | "photo"} the pane that was used last */
  active = "scan";
  /** @type {(import("./picking.js").Pair & {id: string | null})[]} pairs on their way */
  sent = [];
  /** @type {{side: "scan" | "photo", uv: number[], moved: boolean} | null} the keyboard's crosshair */
  cursor = null;
  /** @type {{open: import("./picking.js").Drawn, samples: [number[], boolean][]} | null} samples of the open line */
  openSamples = null;
  /** @type {{side: "scan" | "photo", id: string, index: number} | null} the end that keys are moving */
  nudged = null;
  /** Called when a corner near the pointer is told, or that there is none. */
  onSnapped = () => {};
  /** Called after each stroke. */
  onTaken = () => {};
  /** Whether Alt is held. */
  inverted = false;
  #marks = {};
  #marked = new Map();
  #fading = 0;
  #corners = {};

  constructor({ store, view, ask }) {
    this.look = readLook();
    addEventListener("resize", () => Object.assign(this.look, readLook()));
    this.store = store;
    this.view = view;
    this.ask = ask;
    this.sides = { scan: new ScanSide(store, view), photo: new PhotoSide(store, view) };
    this.edits = new Edits(
      (id, side, ends) => this.#tellEnds(id, side, ends),
      () => this.changed(),
    );
    this.snapping = new Snapping(
      ask,
      (side) => ({ photo: store.shown() ?? undefined, view: side === "scan" ? this.sides.scan.index : undefined }),
      () => {
        this.onSnapped();
        this.redraw("live");
      },
    );
  }

  async #tellEnds(id, side, ends) {
    try {
      await this.ask("set_pick", { photo: this.store.shown(), pick: id, [side === "scan" ? "scan" : "photo_uv"]: ends });
    } catch (error) {
      this.say(error);
      throw error;
    }
  }

  /** Tell the operator what was refused. */
  say(error) {
    this.store.take({ event: "notice", level: "bad", text: error.message });
  }

  /** The matches have changed: work them out again, and draw. */
  changed() {
    this.#marks = {};
    this.#corners = {};
    this.redraw("matches", "live");
  }

  redraw(...layers) {
    for (const pane of Object.values(this.panes)) pane.invalidate(...layers);
  }

  /** @returns {import("./marks.js").Mark[]} of the shown photograph's matches */
  marks(side) {
    const { store } = this;
    this.#marks[side] ??= this.sides[side].extent
      ? marksOf(side, store.picksOf(), store.judgedOf(), this.sides[side].lens, (pick) => this.edits.endsOf(pick, side))
      : [];
    return this.#marks[side];
  }

  /** @returns {number[][]} corners that were found, in pixels */
  corners(side) {
    this.#corners[side] ??= (this.store.get(`corners:${this.store.shown()}`)?.[side] ?? [])
      .map((world) => this.sides[side].toPixel(world))
      .filter(Boolean);
    return this.#corners[side];
  }

  /** @returns {boolean} */
  get showsCorners() {
    return this.view.get().corners !== false;
  }

  /** @returns {any} a pick of the shown photograph by its id, or null */
  pick(id) {
    return this.store.picksOf().find((pick) => pick.id === id) ?? null;
  }

  /** @returns {boolean} whether ends go to corners now */
  get snaps() {
    return this.view.get().snap !== this.inverted;
  }

  /** @returns {boolean} whether a pose is shown */
  get posed() {
    return this.store.stageOf() !== null;
  }

  /** Select, by id; the end by its index, on the side that was used last. */
  select(ids, index = null) {
    this.view.set({ selected: new Set(ids), end: index === null ? null : { side: this.active, index } });
  }

  /** @returns {string | null} the id of the only selected match */
  get chosen() {
    const { selected } = this.view.get();
    return selected.size === 1 ? [...selected][0] : null;
  }

  /** @returns {import("./picking.js").Place} */
  placeAt(side, uv, time_ms = performance.now()) {
    return { world: this.sides[side].toWorld(uv), uv, zoom: this.panes[side].viewport.zoom, time_ms };
  }

  /** Put the keyboard's crosshair on a pixel; a line being drawn follows it. */
  moveCursor(side, uv) {
    const pane = this.panes[side];
    this.cursor = { side, uv, moved: true };
    this.picking.move(side, this.placeAt(side, uv));
    if (pane.screenOf(uv).some((at, axis) => at < 0 || at > pane.size[axis])) pane.place(centredOn(uv, pane.viewport.zoom, pane.size), "hand");
    this.redraw("live");
  }

  /** @returns {boolean} whether the keyboard's crosshair is to be seen in a pane */
  cursorShown(side) {
    return this.cursor?.side === side && document.activeElement === this.panes[side].body;
  }

  /** Point at a place for some seconds. */
  mark(side, uv) {
    this.#marked.set(side, uv);
    clearTimeout(this.#fading);
    this.#fading = setTimeout(() => {
      this.#marked.clear();
      this.redraw("live");
    }, MARKED_MS);
    this.redraw("live");
  }

  /** @returns {number[] | undefined} the pixel that is pointed at */
  marked(side) {
    return this.#marked.get(side);
  }

  /** What comes of a stroke: a first side waits for its partner, a pair goes to the workbench. */
  took(outcome) {
    if (outcome === "open") this.#opened();
    else if (typeof outcome === "object" && outcome) this.#send(outcome);
    this.hint();
    this.onTaken();
    this.redraw("live");
  }

  hint() {
    const pictured = Boolean(this.sides.scan.extent && this.sides.photo.extent);
    const hint = pictured ? hintOf(this.picking, this.view.get().tool) : null;
    if (hint !== this.view.get().hint) this.view.set({ hint });
  }

  /** Abandon what is begun. @returns {boolean} whether there was something */
  abandon() {
    const any = this.picking.abandon();
    if (any) this.took("nothing");
    return any;
  }

  /** Accept the predicted partner. @returns {boolean} whether there was one */
  accept() {
    const pair = this.picking.accept();
    if (pair) this.took(pair);
    return pair !== null;
  }

  /** Ask what is known of a line as soon as it is drawn: its samples, and the partner that the pose predicts. */
  #opened() {
    const { open } = this.picking;
    this.openSamples = null;
    if (open.side === "scan" && open.kind === "line") this.#sample(open);
    if (this.posed) this.#predict(open);
  }

  async #sample(open) {
    try {
      const { scan_samples: samples } = await this.ask("sample_line", { scan: open.ends });
      this.openSamples = { open, samples };
    } catch {
      return; // they are shown again with the finished match
    }
    this.redraw("live");
  }

  async #predict(open) {
    const given = { [open.side === "scan" ? "scan" : "photo_uv"]: open.ends };
    try {
      const answer = await this.ask("predict", { photo: this.store.shown(), side: open.side, ...given });
      this.picking.offer(open, answer[other(open.side) === "scan" ? "scan" : "photo_uv"]);
    } catch {
      return; // without a prediction the partner is drawn by hand
    }
    this.took("nothing");
  }

  async #send(pair) {
    const first = this.active === "scan" ? "photo" : "scan";
    const entry = { ...pair, id: null };
    this.sent.push(entry);
    const gone = () => {
      this.sent = this.sent.filter((other) => other !== entry);
      this.redraw("live");
    };
    try {
      const { pick } = await this.ask("add_pick", { photo: this.store.shown(), kind: pair.kind, scan: pair.scan, photo_uv: pair.photo });
      entry.id = typeof pick === "object" && pick ? pick.id : pick;
      if (this.picking.idle) this.select([entry.id], pair[this.active].length - 1);
      this.arrived();
      setTimeout(gone, SENT_LINGERS_MS);
    } catch (error) {
      gone();
      this.say(error);
      this.picking.reopen({ side: first, kind: pair.kind, ends: pair[first] });
      this.took("nothing");
    }
  }

  /** Pairs that the workbench shows need not be drawn here any longer. */
  arrived() {
    this.sent = this.sent.filter(({ id }) => id === null || !this.pick(id));
  }
}
