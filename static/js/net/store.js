/**
 * The page's copy of the document, slice by slice (docs/workbench.md). It is read-only: edits are sent as commands and
 * come back as slices.
 */

import { changed as applied } from "./delta.js";

/**
 * @typedef {import("../protocol.d.ts").Slices} Slices
 * @typedef {import("../protocol.d.ts").Events} Events
 * @typedef {import("../protocol.d.ts").Pick} Pick
 * @typedef {import("../protocol.d.ts").Photo} Photo
 * @typedef {Slices["poses:"]["stages"][number]} Stage
 * @typedef {import("../protocol.d.ts").Job} Job
 * @typedef {import("../protocol.d.ts").Person} Person
 * @typedef {NonNullable<Slices["scan"]>} Scan
 */
/**
 * The slices that a pattern names: one of them, or all those whose names begin with what precedes `*`.
 * @template {string} Pattern
 * @typedef {Pattern extends keyof Slices ? Slices[Pattern] : Pattern extends `${infer Name}:*` ?
 *   `${Name}:` extends keyof Slices ? Slices[`${Name}:`] : never : never} SliceOf
 */

/** @param {string} pattern @param {string} name */
const matches = (pattern, name) => (pattern.endsWith("*") ? name.startsWith(pattern.slice(0, -1)) : pattern === name);

/** Slices by name, with their listeners. */
export class Store {
  /** @type {Map<string, unknown>} */
  #slices = new Map();
  /** @type {Set<{pattern: string, listen: (value: any, slice: string) => void}>} */
  #listeners = new Set();
  /** @type {Set<{patterns: string[], draw: () => void}>} */
  #watchers = new Set();
  /** @type {Map<string, Set<(event: any) => void>>} */
  #events = new Map();

  /** Number of the newest message with slices; 0 before the first. */
  version = 0;

  /**
   * Return a slice, or null if there is none.
   * @template {keyof Slices} Name
   * @param {Name} slice
   * @returns {Slices[Name] | null}
   */
  get(slice) {
    return /** @type {Slices[Name] | undefined} */ (this.#slices.get(slice)) ?? null;
  }

  /**
   * Call `listen(value, slice)` whenever a slice changes, once the whole message is applied.
   * @template {string} Pattern
   * @param {Pattern} pattern name of a slice, or a prefix followed by `*`
   * @param {(value: SliceOf<Pattern> | null, slice: string) => void} listen
   * @returns {() => void} removes the listener
   */
  on(pattern, listen) {
    const entry = { pattern, listen };
    this.#listeners.add(entry);
    return () => this.#listeners.delete(entry);
  }

  /**
   * Call `draw()` once for each message that changes any of the slices.
   * @param {string[]} patterns
   * @param {() => void} draw
   * @returns {() => void} removes the listener
   */
  watch(patterns, draw) {
    const entry = { patterns, draw };
    this.#watchers.add(entry);
    return () => this.#watchers.delete(entry);
  }

  /**
   * Call `listen(event)` at each event of a kind: `simplex`, `hover`, `cursor`, `view`, `notice`, `export_ready`.
   * @template {keyof Events} Kind
   * @param {Kind} kind
   * @param {(event: Events[Kind]) => void} listen
   * @returns {() => void} removes the listener
   */
  onEvent(kind, listen) {
    const listeners = this.#events.get(kind) ?? new Set();
    this.#events.set(kind, listeners.add(listen));
    return () => listeners.delete(listen);
  }

  /**
   * Apply a message of the server: slices, changes of slices, or an event. Message 1 contains all slices.
   * @param {any} message
   * @returns {boolean} false if it does not continue this copy: nothing was applied, and all slices are needed again
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
      for (const [name, change] of Object.entries(message.changes ?? {})) slices[name] = applied(this.#slices.get(name) ?? null, change);
    } catch (error) {
      if (error instanceof RangeError) return false;
      throw error;
    }
    this.version = version;
    this.#apply(slices);
    return true;
  }

  /** @param {Record<string, any>} slices @returns {Record<string, any>} all slices of message 1, and null for those that exist no longer */
  #all(slices) {
    const removed = [...this.#slices.keys()].filter((name) => !(name in slices));
    return { ...Object.fromEntries(removed.map((name) => [name, null])), ...slices };
  }

  /** @param {Record<string, any>} slices */
  #apply(slices) {
    const changed = Object.keys(slices);
    for (const name of changed) {
      if (slices[name] === null) this.#slices.delete(name);
      else this.#slices.set(name, slices[name]);
    }
    for (const name of changed) {
      for (const { pattern, listen } of [...this.#listeners]) if (matches(pattern, name)) listen(this.#slices.get(name) ?? null, name);
    }
    for (const { patterns, draw } of [...this.#watchers]) {
      if (changed.some((name) => patterns.some((pattern) => matches(pattern, name)))) draw();
    }
  }

  /** @returns {Person[]} the entries of slice `people`; none before the first message */
  clients() {
    return this.get("people")?.clients ?? [];
  }

  /** @returns {Person | null} this page's own entry of slice `people`, or null before the first message */
  me() {
    const you = this.get("people")?.you;
    return this.clients().find(({ id }) => id === you) ?? null;
  }

  /** @returns {boolean} whether this page may only look */
  get readOnly() {
    return Boolean(this.me()?.read_only);
  }

  /** @returns {Person[]} the entries of slice `people` of everybody else */
  colleagues() {
    const you = this.get("people")?.you;
    return this.clients().filter(({ id }) => id !== you);
  }

  /** @returns {string | null} id of the photograph that this page shows */
  shown() {
    return this.get("shown");
  }

  /**
   * @param {string | null} [photo] by default the shown one
   * @returns {Photo | null} its entry of slice `photos`, or null
   */
  photo(photo = this.shown()) {
    return this.photos().find(({ id }) => id === photo) ?? null;
  }

  /** @returns {Photo[]} slice `photos`; empty before it has arrived */
  photos() {
    return this.get("photos") ?? [];
  }

  /** @returns {Scan | null} the scan that is shown beside the photograph, as slice `scan`: the project's or another station's */
  scanBeside() {
    return this.get("beside") ?? this.get("scan");
  }

  /** @returns {string} id of the station that the photograph is matched with; empty: the project's scan */
  station() {
    return this.get("partner")?.station ?? "";
  }

  /**
   * @param {string | null} [photo]
   * @returns {Pick[]} its picks, in order; empty if there are none
   */
  picksOf(photo = this.shown()) {
    return this.get(`picks:${photo}`) ?? [];
  }

  /**
   * @param {string | null} [photo]
   * @returns {Slices["judged:"] | null} slice `judged:pID`: its picks under the shown pose; or null
   */
  judgedOf(photo = this.shown()) {
    return this.get(`judged:${photo}`);
  }

  /**
   * @param {string | null} [photo]
   * @returns {Slices["poses:"] | null} slice `poses:pID`, or null
   */
  posesOf(photo = this.shown()) {
    return this.get(`poses:${photo}`);
  }

  /**
   * @param {string | null} [photo]
   * @returns {Stage | null} the shown stage of the photograph, or null if there is no pose
   */
  stageOf(photo = this.shown()) {
    const poses = this.posesOf(photo);
    return poses?.stages.find(({ stage }) => stage === poses.shown) ?? null;
  }
}

export const store = new Store();

/**
 * CSS custom property with the colour of a match, for use over pictures.
 * @param {number} number of the match, from 1
 * @returns {string} such as `--lr-match-3`
 */
export const matchColour = (number) => `--lr-match-${((number - 1) % 6) + 1}`;

/**
 * CSS custom property with the colour of a match, for thin strokes on the page's background.
 * @param {number} number of the match, from 1
 * @returns {string} such as `--lr-stem-3`
 */
export const stemColour = (number) => `--lr-stem-${((number - 1) % 6) + 1}`;
