/**
 * Exact squares of a picture, for the visible part of it at the resolution of the screen: on a slow link only the quick
 * picture is loaded as a whole.
 */

import { loadBitmap } from "./picture_source.js";

/** Side of a part, pixels of its level; level 1 is half the size, and so on. */
const PART_PX = 256;
const MAX_LEVEL = 12;
const RESTS_MS = 120;
const AT_A_TIME = 3;
const KEPT = 160;

/** @param {number} length @param {number} level */
const halved = (length, level) => {
  let left = length;
  for (let k = 0; k < level; k += 1) left = Math.ceil(left / 2);
  return left;
};

/**
 * @param {number} scale
 * @returns {number} the coarsest level that has a pixel per screen pixel; `scale`: screen pixels per picture pixel
 */
const levelAt = (scale) => Math.min(MAX_LEVEL, Math.max(0, Math.floor(-Math.log2(Math.max(scale, 1e-6)) + 1e-6)));

/** The parts of one picture. */
export class PictureParts {
  #address;
  #size;
  #quickWidth;
  #changed;
  /** @type {Map<string, ImageBitmap>} */
  #known = new Map();
  /** @type {Map<string, string[]>} */
  #wanted = new Map();
  /** @type {Set<string>} */
  #loading = new Set();
  /** @type {Set<string>} */
  #refused = new Set();
  #timer = 0;

  /**
   * @param {string} address of the picture
   * @param {readonly number[]} size width and height of the exact picture
   * @param {number} quickWidth width of the picture that is shown where parts are missing
   * @param {() => void} changed called when a part has arrived, or loading begins or ends
   */
  constructor(address, size, quickWidth, changed) {
    this.#address = address;
    this.#size = size;
    this.#quickWidth = quickWidth;
    this.#changed = changed;
  }

  /** @returns {boolean} whether parts are being loaded */
  get loading() {
    return this.#loading.size > 0;
  }

  /**
   * The parts of a region that have arrived; the others are loaded once the picture rests.
   * @param {string} viewer whose region it is: the pane or its loupe
   * @param {readonly number[]} region left, top, right, bottom, pixels of the exact picture
   * @param {number} scale screen pixels per pixel of the exact picture
   * @returns {{bitmap: ImageBitmap, left: number, top: number, width: number, height: number}[]} in pixels of the exact
   *   picture; none if the quick picture is as fine as the screen
   */
  within(viewer, [left, top, right, bottom], scale) {
    const missing = [];
    const found = [];
    const [width, height] = this.#size;
    if (scale * width > this.#quickWidth) {
      const level = levelAt(scale);
      const [across, down] = [halved(width, level), halved(height, level)];
      const [sx, sy] = [across / width, down / height];
      /** @param {number} from @param {number} to @param {number} share @param {number} whole */
      const span = (from, to, share, whole) => [
        Math.max(0, Math.floor((from * share) / PART_PX)),
        Math.min(Math.ceil(whole / PART_PX), Math.ceil((to * share) / PART_PX)),
      ];
      const [firstColumn, endColumn] = span(left, right, sx, across);
      const [firstRow, endRow] = span(top, bottom, sy, down);
      for (let row = firstRow; row < endRow; row += 1) {
        for (let column = firstColumn; column < endColumn; column += 1) {
          const name = `${level}.${column}.${row}`;
          const bitmap = this.#known.get(name);
          if (!bitmap) {
            missing.push(name);
            continue;
          }
          this.#known.delete(name); // the most recently shown ones are the last
          this.#known.set(name, bitmap);
          const [x, y] = [column * PART_PX, row * PART_PX];
          found.push({ bitmap, left: x / sx, top: y / sy, width: bitmap.width / sx, height: bitmap.height / sy });
        }
      }
    }
    this.#want(viewer, missing);
    return found;
  }

  /** Load no more; another picture is shown. */
  stop() {
    clearTimeout(this.#timer);
    this.#wanted.clear();
  }

  /** @param {string} viewer @param {string[]} names */
  #want(viewer, names) {
    const before = this.#wanted.get(viewer) ?? [];
    if (names.length === before.length && names.every((name, k) => name === before[k])) return;
    this.#wanted.set(viewer, names);
    clearTimeout(this.#timer);
    if (names.length) this.#timer = setTimeout(() => this.#loadNext(), RESTS_MS);
  }

  #loadNext() {
    const names = ["loupe", "pane"].flatMap((viewer) => this.#wanted.get(viewer) ?? []);
    const next = names.filter((name) => !this.#known.has(name) && !this.#loading.has(name) && !this.#refused.has(name));
    const began = this.#loading.size;
    for (const name of next.slice(0, Math.max(0, AT_A_TIME - began))) this.#load(name);
    if (!began && this.#loading.size) this.#changed();
  }

  /** @param {string} name */
  async #load(name) {
    this.#loading.add(name);
    try {
      this.#known.set(name, await loadBitmap(`${this.#address}&part=${name}`));
      for (const oldest of this.#known.keys()) {
        if (this.#known.size <= KEPT) break;
        this.#known.delete(oldest);
      }
    } catch {
      this.#refused.add(name); // the quick picture remains there
    }
    this.#loading.delete(name);
    this.#loadNext();
    this.#changed();
  }
}
