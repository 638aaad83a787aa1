/**
 * Contrast in the browser while a slider is dragged: the 8-bit picture that is shown is stretched as the workbench would
 * stretch the measured values. It is a preview; the picture itself follows when the slider is released.
 */

import { drawing } from "../ui/canvas.js";

/** @typedef {{show: string, low: number, high: number, gamma: number, equalise: boolean}} Stretch */

const STRETCHABLE = new Set(["intensity", "raw", "range"]);
const LEVELS = 256;
/** Pixels without a return are bluish black in every picture of the scan. */
const EMPTY = LEVELS;
/** @param {number} r @param {number} g @param {number} b */
const isEmpty = (r, g, b) => b <= 22 && b - r >= 2;
const MAX_PIXELS = 2_000_000;
/** @type {(keyof Stretch)[]} */
const COMPARED = ["show", "low", "high", "gamma", "equalise"];

/** @param {Stretch} from @param {Stretch} to @returns {boolean} whether a picture of one stretch can preview another */
export const canPreview = (from, to) =>
  STRETCHABLE.has(from.show) && from.show === to.show && !from.equalise && !to.equalise;

/** @param {{low: number, high: number}} stretch @returns {number} how much of the values a stretch maps to distinct levels, per cent */
export const widthOf = ({ low, high }) => high - low;

/** @param {Stretch} a @param {Stretch} b @returns {boolean} */
export const sameStretch = (a, b) => COMPARED.every((name) => a[name] === b[name]);

/** A picture prepared for being stretched. */
export class StretchedPicture {
  #stretch;
  #levels = new Uint16Array();
  #shares = new Float64Array(LEVELS);
  #colours = new Uint8Array();
  #known = 0;
  #least = 0;
  #most = LEVELS - 1;
  #image;
  #context;

  /**
   * @param {import("./picture_layer.js").Picture} picture
   * @param {Stretch} stretch that it was made with
   */
  constructor(picture, stretch) {
    const share = Math.min(1, Math.sqrt(MAX_PIXELS / (picture.width * picture.height)));
    const bitmap = picture.at(share);
    this.#stretch = stretch;
    this.#context = drawing(new OffscreenCanvas(bitmap.width, bitmap.height).getContext("2d", { willReadFrequently: true }));
    this.#context.drawImage(bitmap, 0, 0);
    this.#image = this.#context.getImageData(0, 0, bitmap.width, bitmap.height);
    this.#read();
    this.width = bitmap.width;
    this.height = bitmap.height;
  }

  /** Take down the level of each pixel, the share of pixels up to each level, and the colour of each level. */
  #read() {
    const { data } = this.#image;
    this.#levels = new Uint16Array(data.length / 4);
    const counts = new Float64Array(LEVELS);
    const sums = new Float64Array(3 * LEVELS);
    for (let k = 0; k < this.#levels.length; k += 1) {
      const [r, g, b] = [data[4 * k], data[4 * k + 1], data[4 * k + 2]];
      const level = isEmpty(r, g, b) ? EMPTY : Math.round(0.299 * r + 0.587 * g + 0.114 * b);
      this.#levels[k] = level;
      if (level === EMPTY) continue;
      counts[level] += 1;
      sums[3 * level] += r;
      sums[3 * level + 1] += g;
      sums[3 * level + 2] += b;
    }
    const present = [...counts.keys()].filter((level) => counts[level] > 0);
    [this.#least, this.#most] = [present[0] ?? 0, present.at(-1) ?? LEVELS - 1];
    this.#known = counts.reduce((sum, count) => sum + count, 0);
    let sum = 0;
    for (let level = 0; level < LEVELS; level += 1) {
      sum += counts[level];
      this.#shares[level] = sum / Math.max(1, this.#known);
    }
    this.#colours = coloursOf(present, counts, sums);
  }

  /**
   * @param {number} percent
   * @returns {number} the value, 0 black to 1 white, below which a percentage of the measured values lies
   */
  #valueAt(percent) {
    const { low, high } = this.#stretch;
    if (percent <= low) return 0;
    if (percent >= high) return 1;
    const level = this.#shares.findIndex((share) => share >= percent / 100);
    return this.#valueOf(level < 0 ? this.#most : level);
  }

  /** @param {number} level */
  #valueOf(level) {
    const share = (level - this.#least) / Math.max(1, this.#most - this.#least);
    return Math.max(0, Math.min(1, share)) ** (1 / this.#gammaOf(this.#stretch));
  }

  /** @param {Stretch} stretch */
  #gammaOf({ show, gamma }) {
    return show === "range" ? 1 : gamma;
  }

  /**
   * Stretch the picture otherwise.
   * @param {Stretch} wanted
   * @returns {StretchedPicture} itself, with its new pixels
   */
  to(wanted) {
    const [black, white] = [this.#valueAt(wanted.low), this.#valueAt(wanted.high)];
    const table = new Uint32Array(LEVELS + 1);
    const bytes = new Uint8Array(table.buffer);
    for (let level = 0; level < LEVELS; level += 1) {
      const value = (this.#valueOf(level) - black) / Math.max(1e-6, white - black);
      const share = Math.max(0, Math.min(1, value)) ** this.#gammaOf(wanted);
      const at = Math.round(this.#least + share * (this.#most - this.#least));
      bytes.set([...this.#colours.subarray(3 * at, 3 * at + 3), 255], 4 * level);
    }
    bytes.set([11, 12, 15, 255], 4 * EMPTY);
    const pixels = new Uint32Array(this.#image.data.buffer);
    for (let k = 0; k < pixels.length; k += 1) pixels[k] = table[this.#levels[k]];
    this.#context.putImageData(this.#image, 0, 0);
    return this;
  }

  /** @returns {OffscreenCanvas} as `Picture.at` */
  at() {
    return this.#context.canvas;
  }
}

/**
 * @param {number[]} present
 * @param {Float64Array} counts
 * @param {Float64Array} sums
 * @returns {Uint8Array} the mean colour of each level, (256 x 3); between those present, interpolated
 */
const coloursOf = (present, counts, sums) => {
  const colours = new Uint8Array(3 * LEVELS);
  let after = 0;
  for (let level = 0; level < LEVELS; level += 1) {
    while (after < present.length - 1 && present[after] < level) after += 1;
    const [b, a] = [present[after] ?? 0, present[Math.max(0, after - 1)] ?? 0];
    const share = b > a ? Math.max(0, Math.min(1, (level - a) / (b - a))) : 1;
    for (let k = 0; k < 3; k += 1) {
      /** @param {number} at */
      const mean = (at) => sums[3 * at + k] / Math.max(1, counts[at]);
      colours[3 * level + k] = Math.round(mean(a) + share * (mean(b) - mean(a)));
    }
  }
  return colours;
};
