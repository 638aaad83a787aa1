/**
 * The document as the server tells it, slice by slice (docs/workbench.md). Nothing here changes it: edits are asked for
 * over the connection and come back as slices.
 */

import { changed as after } from "./delta.js";

/**
 * @typedef {{id: string, number: number, kind: "point" | "line", scan: number[][], photo: number[][], on: boolean,
 *            weight: number, origin: string}} Pick
 * @typedef {(value: any, slice: string) => void} SliceListener
 */

const matches = (pattern, name) => (pattern.endsWith("*") ? name.startsWith(pattern.slice(0, -1)) : pattern === name);

/** Slices by name, and who listens to them. */
export class Store {
  #slices = new Map();
  #listeners = new Set();
  #watchers = new Set();
  #events = new Map();

  /** The number of the newest message with slices; 0 before the first. */
  version = 0;

  /**
   * Return a slice, or null.
   * @param {string} slice
   * @returns {any}
   */
  get(slice) {
    return this.#slices.get(slice) ?? null;
  }

  /**
   * Call `listen(value, slice)` each time that a slice changes, after the whole message is in.
   * @param {string} pattern a slice's name, or a beginning followed by `*`
   * @param {SliceListener} listen
   * @returns {() => void} stops it
   */
  on(pattern, listen) {
    const entry = { pattern, listen };
    this.#listeners.add(entry);
    return () => this.#listeners.delete(entry);
  }

  /**
   * Call `draw()` once a message that changes any of the slices.
   * @param {string[]} patterns
   * @param {() => void} draw
   * @returns {() => void} stops it
   */
  watch(patterns, draw) {
    const entry = { patterns, draw };
    this.#watchers.add(entry);
    return () => this.#watchers.delete(entry);
  }

  /**
   * Call `listen(event)` at each event of a kind: `simplex`, `hover`, `notice`, `export_ready`.
   * @param {string} kind
   * @param {(event: any) => void} listen
   * @returns {() => void} stops it
   */
  onEvent(kind, listen) {
    if (!this.#events.has(kind)) this.#events.set(kind, new Set());
    this.#events.get(kind).add(listen);
    return () => this.#events.get(kind).delete(listen);
  }

  /**
   * Take a message of the server: slices, changes of slices, or an event. Message 1 tells all slices that there are.
   * @param {any} message
   * @returns {boolean} false: it does not follow on what is here, so that nothing was taken and all must be told anew
   */
  take(message) {
    if (typeof message.event === "string") {
      for (const listen of this.#events.get(message.event) ?? []) listen(message);
      return true;
    }
    if (!message.slices) return true;
    const { version = this.version + 1 } = message;
    const slices = version === 1 ? this.#all(message.slices) : { ...message.slices };
    if (version !== 1 && version !== this.version + 1) return false;
    try {
      for (const [name, change] of Object.entries(message.changes ?? {})) slices[name] = after(this.get(name), change);
    } catch (error) {
      if (error instanceof RangeError) return false;
      throw error;
    }
    this.version = version;
    this.#put(slices);
    return true;
  }

  /** All slices that are told, and null for every other that is here. */
  #all(told) {
    const others = [...this.#slices.keys()].filter((name) => !(name in told));
    return { ...Object.fromEntries(others.map((name) => [name, null])), ...told };
  }

  #put(slices) {
    const changed = Object.keys(slices);
    for (const name of changed) {
      if (slices[name] === null) this.#slices.delete(name);
      else this.#slices.set(name, slices[name]);
    }
    for (const name of changed) {
      for (const { pattern, listen } of [...this.#listeners]) if (matches(pattern, name)) listen(this.get(name), name);
    }
    for (const { patterns, draw } of [...this.#watchers]) {
      if (changed.some((name) => patterns.some((pattern) => matches(pattern, name)))) draw();
    }
  }

  /** @returns {string | null} the id of the photograph that all look at */
  shown() {
    return this.get("shown");
  }

  /**
   * @param {string | null} [photo] the shown one where it is left out
   * @returns {any} the entry of slice `photos`, or null
   */
  photo(photo = this.shown()) {
    return (this.get("photos") ?? []).find((entry) => entry.id === photo) ?? null;
  }

  /**
   * @param {string | null} [photo]
   * @returns {Pick[]} its picks, in order; empty where there are none
   */
  picksOf(photo = this.shown()) {
    return this.get(`picks:${photo}`) ?? [];
  }

  /**
   * @param {string | null} [photo]
   * @returns {any} what the shown pose says of its picks, or null
   */
  judgedOf(photo = this.shown()) {
    return this.get(`judged:${photo}`);
  }

  /**
   * @param {string | null} [photo]
   * @returns {any} slice `poses:pID`, or null
   */
  posesOf(photo = this.shown()) {
    return this.get(`poses:${photo}`);
  }

  /**
   * @param {string | null} [photo]
   * @returns {any} the shown stage of the photograph, or null before there is a pose
   */
  stageOf(photo = this.shown()) {
    const poses = this.posesOf(photo);
    return poses?.stages.find((stage) => stage.stage === poses.shown) ?? null;
  }
}

export const store = new Store();

/**
 * The CSS custom property of a match's colour.
 * @param {number} number from 1
 * @returns {string} such as `--lr-match-3`
 */
export const matchColour = (number) => `--lr-match-${((number - 1) % 6) + 1}`;

/**
 * The same where thin strokes lie on the page's own ground instead of on a picture.
 * @param {number} number from 1
 * @returns {string} such as `--lr-stem-3`
 */
export const stemColour = (number) => `--lr-stem-${((number - 1) % 6) + 1}`;
