/**
 * Picking of points to be measured, in both pictures and on the model: press and release set one; the workbench says at once
 * what it is worth, or why it is none. A distance, an angle and a point are kept with their last point, the others when they are
 * finished.
 */

import { MEASURES } from "../state/measuring.js";
import { scanOfStation, stationsNow } from "../state/stations.js";
import { messageOf } from "../ui/faults.js";

/** @typedef {import("./picking.js").Side} Side */

const CLICK_PX = 6;
const DOUBLE_CLICK_MS = 400;
const PICKED_PX = 0.5; // standard deviation of a click along each axis, on the screen as in a picture
const [MAX_RAD, MAX_PX] = [0.2, 1000];

/**
 * @typedef {{side: "scan" | "photo", of: string | null, station: string, world: number[], sigma: number}} Place `of`: id of
 *   the photograph; `station`: id of the station whose scan it was picked in, or stood beside the photograph; `sigma`:
 *   standard deviation of the click along each axis, rad of a ray or pixels of the photograph
 */

/** @param {number} value */
const rounded = (value) => Number(value.toPrecision(2)); // points of one zoom are measured together

/** @param {Place} place @returns {import("../protocol.d.ts").MeasurementPlace} a point as the workbench takes it */
const sent = ({ side, of, world, sigma }) => {
  if (side === "scan") return { ray: world, sigma_rad: Math.min(MAX_RAD, rounded(sigma)) };
  const coarse = sigma > PICKED_PX ? { sigma_px: Math.min(MAX_PX, rounded(sigma)) } : {};
  return { photo: of ?? undefined, uv: world, ...coarse };
};

/** What is being measured. */
export class Measuring {
  /** @type {Place[]} the points picked so far */
  places = [];
  /** @type {{value: string, interval: string, notes: string[]} | null} what they measure so far */
  soFar = null;
  /** @type {"scan" | "photo" | null} the picture in which the pointer is pressed */
  pressed = null;
  /** @type {string | null} id of the measurement that was completed last, while nothing else is begun */
  made = null;
  /** @type {string} one sentence on the last point or the last measurement */
  said = "";
  #controller;
  /** @type {Set<() => void>} */
  #listeners = new Set();
  #asked = 0;
  /** @type {{on: string, position: import("./picking.js").PickPosition} | null} the last click */
  #last = null;
  /** @type {string | null} */
  #grid = null;

  /** @param {import("./controller.js").Controller} controller */
  constructor(controller) {
    this.#controller = controller;
    controller.view.on((_, changed) => {
      if (changed.has("tool") || changed.has("measures")) this.clear();
    });
    controller.store.watch(["scan"], () => {
      const grid = controller.store.get("scan")?.grid ?? null;
      if (this.#grid && grid !== this.#grid) this.clear(); // stations have other names from then on
      this.#grid = grid;
    });
  }

  /** @param {() => void} listen called when anything here has changed */
  onChange(listen) {
    this.#listeners.add(listen);
  }

  #changed() {
    for (const listen of this.#listeners) listen();
    this.#controller.hint();
    this.#controller.redraw("live");
  }

  get kind() {
    return this.#controller.view.get().measures;
  }

  /** @returns {boolean} whether Enter or a button keeps what was picked: its number of points is open, and enough */
  get finishable() {
    const { least, most } = MEASURES[this.kind];
    return most === null && this.places.length >= least;
  }

  /** @returns {string} what to do next */
  get hint() {
    const { places, kind } = this;
    const { points } = MEASURES[kind];
    const next = points[Math.min(places.length, points.length - 1)];
    const back = places.length ? " · Esc takes the last point back" : "";
    const on = stationsNow().stations.length ? ` · Measured on the scan of ${scanOfStation(this.station)}` : "";
    return `Click ${next} in a picture or on the model${this.finishable ? " · Enter or a double click finishes" : ""}${back}${on}`;
  }

  /** @returns {string} id of the station whose scan is measured: the one that was picked in, or stood beside the first photograph */
  get station() {
    const { places } = this;
    return (places.find(({ side }) => side === "scan") ?? places[0])?.station ?? this.#controller.store.station();
  }

  /**
   * @param {Side} side
   * @param {Place} place
   * @param {string} station
   * @returns {boolean} whether a point was picked in what a pane shows, for a scan the one of a station
   */
  #isIn(side, place, station) {
    return place.side === side && (side === "scan" ? place.station === station : place.of === this.#controller.store.shown());
  }

  /**
   * @param {"scan" | "photo"} side
   * @param {string} station id of the station whose scan is shown
   * @returns {number[][][]} for a pane, runs of the points that were picked in it one after the other
   */
  runs(side, station = this.#controller.store.station()) {
    /** @type {number[][][]} */
    const found = [];
    /** @type {number[][] | null} */
    let run = null;
    for (const place of this.places) {
      const here = this.#isIn(side, place, station);
      if (here && run) run.push(place.world);
      else if (here) found.push((run = [place.world]));
      else run = null;
    }
    return found;
  }

  /** @param {Side} side @returns {boolean} whether the last point was picked in a pane: the next line begins there */
  endsIn(side) {
    const last = this.places.at(-1);
    return last !== undefined && this.#isIn(side, last, this.#controller.store.station());
  }

  /** @param {Side} side */
  press(side) {
    this.pressed = side;
  }

  /** @param {Side} side @param {import("./picking.js").PickPosition} position @returns {number} what a click in a picture is worth at its zoom, see `Place` */
  #sigma(side, { world, uv, zoom }) {
    const apart = PICKED_PX / zoom;
    if (side === "photo") return apart;
    const beside = this.#controller.sides.scan.toWorld([uv[0] + apart, uv[1]]);
    return Math.hypot(...world.map((value, k) => value - beside[k])); // unit rays
  }

  /** Say something of what was clicked that sets no point. @param {string} sentence */
  say(sentence) {
    this.said = sentence;
    this.#changed();
  }

  /**
   * A click, or a key at the crosshair, sets a point.
   * @param {"scan" | "photo"} side
   * @param {import("./picking.js").PickPosition} position
   * @param {{sigma?: number, on?: string, station?: string}} more `sigma` and `station`: see `Place`, if they are known;
   *   `on`: where it was clicked
   */
  async set(side, position, { sigma = this.#sigma(side, position), on = side, station = this.#controller.store.station() } = {}) {
    this.pressed = null;
    const last = this.#last;
    this.#last = { on, position };
    const again = last?.on === on && position.time_ms - last.position.time_ms < DOUBLE_CLICK_MS
      && Math.hypot(last.position.uv[0] - position.uv[0], last.position.uv[1] - position.uv[1]) * position.zoom < CLICK_PX;
    if (again) {
      if (this.finishable) await this.finish();
      return;
    }
    const { store } = this.#controller;
    if (side === "photo" && !store.photo()) return;
    const elsewhere = side === "scan" && this.places.find((one) => one.side === "scan" && one.station !== station);
    if (elsewhere) {
      this.say(`Started in ${scanOfStation(elsewhere.station)}: continue there, or discard its points (Esc)`);
      return;
    }
    const place = { side, of: side === "photo" ? store.shown() : null, station, world: position.world, sigma };
    this.places.push(place);
    this.made = null;
    this.said = "";
    this.soFar = null;
    this.#changed();
    const { most } = MEASURES[this.kind];
    if (most !== null && this.places.length >= most) await this.finish();
    else await this.#check(place);
  }

  /** A point that lies on no surface is taken back, with the reason; enough of them have a value. @param {Place} place */
  async #check(place) {
    const { kind, station } = this;
    const asked = ++this.#asked;
    try {
      const alone = await this.#controller.ask("measure", { kind: "point", places: [sent(place)], station });
      if (alone.refusal) {
        this.#refuse(place, alone.refusal);
        return;
      }
      if (asked !== this.#asked || !this.finishable || kind !== this.kind) return;
      const found = await this.#controller.ask("measure", { kind, places: this.places.map(sent), station });
      if (asked !== this.#asked) return;
      this.soFar = found.refusal ? null : found;
      this.said = found.refusal ?? "";
    } catch (error) {
      this.#refuse(place, messageOf(error));
      return;
    }
    this.#changed();
  }

  /** @param {Place} place @param {string} why */
  #refuse(place, why) {
    this.places = this.places.filter((each) => each !== place);
    this.said = why;
    this.#changed();
  }

  /** Keep what was picked. @returns {Promise<boolean>} whether there was enough of it */
  async finish() {
    const { kind, places, station } = this;
    if (places.length < MEASURES[kind].least) return false;
    this.#asked++;
    this.places = [];
    this.soFar = null;
    this.said = "Measuring …";
    this.#changed();
    try {
      const { measurement } = await this.#controller.ask("add_measurement", { kind, places: places.map(sent), station });
      this.said = "";
      this.made = measurement;
      this.#controller.view.set({ measurement });
    } catch (error) {
      if (this.places.length === 0 && kind === this.kind) this.places = places.slice(0, -1);
      this.said = messageOf(error);
    }
    this.#changed();
    return true;
  }

  /** Take the last point back. @returns {boolean} whether there was one */
  abandon() {
    this.#asked++;
    this.#last = null;
    this.pressed = null;
    if (this.places.length === 0) return false;
    this.places = this.places.slice(0, -1);
    this.soFar = null;
    this.said = "";
    this.#changed();
    return true;
  }

  /** Forget everything that was picked. */
  clear() {
    this.#asked++;
    this.made = null;
    this.#last = null;
    this.pressed = null;
    this.places = [];
    this.soFar = null;
    this.said = "";
    this.#changed();
  }

  /** Forget points in photographs that exist no longer. @param {string[]} photos ids of those that do */
  forgetPhotosBut(photos) {
    const left = this.places.filter(({ of }) => of === null || photos.includes(of));
    if (left.length < this.places.length) this.clear();
  }
}
