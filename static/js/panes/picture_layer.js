/**
 * Pictures by URL: fetched once, decoded before they are shown, with reduced levels so that large ones pan smoothly.
 * While a new one loads, the old one stays. Unless the link is known to be fast, a small quick picture comes first; on a
 * fast link the whole exact one follows, on a slow one the visible parts of it.
 */

import { linkIsFast } from "../net/link_speed.js";
import { messageOf } from "../ui/faults.js";
import { PictureParts } from "./picture_parts.js";
import { loadBitmap } from "./picture_source.js";
import { canPreview, sameStretch, StretchedPicture, widthOf } from "./picture_stretch.js";

/** @typedef {import("./viewport.js").Viewport} Viewport */

const KEPT = 10;
/** Pixels of all pictures that are kept, four bytes each and a third more for their levels; the newest stays. */
const KEPT_PX = 24e6;
const KEPT_STRETCHES = 3;
const HALVED_ABOVE_PX = 1400;

/** A decoded picture with its reduced levels. */
export class Picture {
  #levels;

  /** @param {ImageBitmap} bitmap */
  constructor(bitmap) {
    this.width = bitmap.width;
    this.height = bitmap.height;
    this.#levels = [bitmap];
  }

  /** Build the reduced levels, each half the size of the one before. */
  async halve() {
    for (;;) {
      const last = this.#levels[this.#levels.length - 1];
      if (Math.max(last.width, last.height) <= HALVED_ABOVE_PX) return;
      /** @type {ImageBitmapOptions} */
      const half = { resizeWidth: Math.ceil(last.width / 2), resizeHeight: Math.ceil(last.height / 2), resizeQuality: "medium" };
      this.#levels.push(await createImageBitmap(last, half));
    }
  }

  /**
   * @param {number} scale
   * @returns {ImageBitmap} the smallest level that still has one pixel per screen pixel; `scale` 1 is full size
   */
  at(scale) {
    const step = Math.max(0, Math.floor(-Math.log2(Math.max(scale, 1e-6)) + 1e-6));
    return this.#levels[Math.min(step, this.#levels.length - 1)];
  }
}

/** @type {Map<string, {picture: Promise<Picture>, pixels: number}>} by address, the newest last; no pixels: it loads */
const cache = new Map();

const trim = () => {
  const pixels = () => [...cache.values()].reduce((sum, one) => sum + one.pixels, 0);
  for (const oldest of cache.keys()) {
    if (cache.size <= 1 || (cache.size <= KEPT && pixels() <= KEPT_PX)) return;
    cache.delete(oldest);
  }
};

/**
 * @param {string} address relative to the page
 * @returns {Promise<Picture>} rejects with an Error whose message is one sentence
 */
export const loadPicture = (address) => {
  const known = cache.get(address);
  cache.delete(address);
  const entry = known ?? { picture: loadBitmap(address).then((bitmap) => new Picture(bitmap)), pixels: 0 };
  cache.set(address, entry);
  trim();
  if (!known) {
    entry.picture.then(
      ({ width, height }) => {
        entry.pixels = width * height;
        trim();
      },
      () => cache.get(address) === entry && cache.delete(address),
    );
  }
  return entry.picture;
};

/** @typedef {import("./picture_stretch.js").Stretch} Stretch */

/** The picture of one layer: the newest that has loaded of its subject. */
export class Slot {
  /** @type {Picture | null} */
  picture = null;
  /** @type {string | null} */
  error = null;
  /** @type {PictureParts | null} */
  #parts = null;
  #loadingWhole = false;
  /** @type {string | null} */
  #address = null;
  /** @type {string | null} */
  #subject = null;
  /** @type {{picture: Picture, stretch: Stretch}[]} pictures of the subject with other contrasts, the newest first */
  #kept = [];
  /** @type {StretchedPicture | null} */
  #preview = null;
  /** @type {{picture: Picture, stretched: StretchedPicture} | null} what the last preview was made of */
  #previewed = null;
  #changed;

  /** @param {() => void} changed called when the picture, its error or its loading state has changed */
  constructor(changed) {
    this.#changed = changed;
  }

  /** @returns {boolean} whether anything is being loaded */
  get loading() {
    return this.#loadingWhole || Boolean(this.#parts?.loading);
  }

  /** @returns {Picture | StretchedPicture | null} what is shown: the picture, or a preview of it with another contrast */
  get shown() {
    return this.#preview ?? this.picture;
  }

  /** @returns {PictureParts | null} exact parts over a quick picture; none over a preview */
  get finer() {
    return this.#preview ? null : this.#parts;
  }

  /**
   * @param {string | null} address null for no picture
   * @param {{subject?: string | null, size?: readonly number[] | null, stretch?: Stretch | null}} [about] `subject`: what is
   *   pictured; when it changes, the old picture disappears at once. `size` of the exact picture, where its parts can be
   *   loaded. `stretch`: its contrast, where it has one
   */
  show(address, { subject = address, size = null, stretch = null } = {}) {
    if (address === this.#address && !this.error) {
      if (!this.#loadingWhole) this.#endPreview(); // the slider is back where it was
      return;
    }
    if (subject !== this.#subject) this.#forget();
    this.#address = address;
    this.#subject = subject;
    this.error = null;
    this.#loadingWhole = address !== null;
    if (address === null) this.#forget();
    this.#changed();
    if (address !== null) this.#load(address, size, stretch);
  }

  /**
   * Show the picture with another contrast, without loading anything.
   * @param {Stretch} stretch
   */
  preview(stretch) {
    const usable = this.#kept.filter((one) => canPreview(one.stretch, stretch));
    if (!usable.length || sameStretch(usable[0].stretch, stretch)) return;
    // the narrowest that contains the wanted values; else the widest, which loses the fewest
    const around = usable.filter(({ stretch: { low, high } }) => low <= stretch.low && high >= stretch.high);
    const best = around.length
      ? around.reduce((a, b) => (widthOf(b.stretch) < widthOf(a.stretch) ? b : a))
      : usable.reduce((a, b) => (widthOf(b.stretch) > widthOf(a.stretch) ? b : a));
    const known = this.#previewed?.picture === best.picture ? this.#previewed : null;
    this.#previewed = known ?? { picture: best.picture, stretched: new StretchedPicture(best.picture, best.stretch) };
    this.#preview = this.#previewed.stretched.to(stretch);
    this.#changed();
  }

  #endPreview() {
    if (!this.#preview) return;
    this.#preview = null;
    this.#changed();
  }

  #forget() {
    this.#parts?.stop();
    this.picture = this.#parts = this.#preview = this.#previewed = null;
    this.#kept = [];
  }

  /**
   * @param {Picture} picture
   * @param {string} address of the exact one
   * @param {readonly number[] | null} size of the exact one, if its parts are to be loaded
   * @param {Stretch | null} stretch
   */
  #put(picture, address, size, stretch) {
    this.#parts?.stop();
    this.picture = picture;
    this.#parts = size && picture.width < size[0] ? new PictureParts(address, size, picture.width, this.#changed) : null;
    this.#preview = null;
    if (stretch) this.#kept = [{ picture, stretch }, ...this.#kept.filter((one) => !sameStretch(one.stretch, stretch))].slice(0, KEPT_STRETCHES);
    picture.halve().then(() => picture === this.picture && this.#changed(), () => {}); // without levels it is only slower
  }

  /** @param {string} address @param {readonly number[] | null} size @param {Stretch | null} stretch */
  async #load(address, size, stretch) {
    try {
      if (!linkIsFast()) {
        const quick = await loadPicture(`${address}&form=quick`);
        if (address !== this.#address) return;
        this.#put(quick, address, size, stretch);
        this.#changed();
      }
      if (!size || linkIsFast() !== false) {
        const picture = await loadPicture(address);
        if (address !== this.#address) return;
        this.#put(picture, address, null, stretch);
      }
    } catch (error) {
      if (address !== this.#address) return;
      this.error = messageOf(error);
      this.#forget();
    }
    this.#loadingWhole = false;
    this.#changed();
  }
}

/**
 * Draw the visible part of a picture.
 * @param {CanvasRenderingContext2D} context in CSS pixels of the pane
 * @param {import("./viewport.js").Viewport} viewport
 * @param {readonly number[]} size of the pane
 * @param {Picture | StretchedPicture} picture
 * @param {readonly number[]} extent width and height that the picture represents, in pixels of the view or photograph
 * @param {boolean} smooth
 * @param {{parts: PictureParts, viewer: string} | null} finer exact parts over the picture, and who looks at them
 */
export const drawPicture = (context, viewport, size, picture, extent, smooth, finer = null) => {
  const ratio = window.devicePixelRatio || 1;
  const source = picture.at((viewport.zoom * ratio * extent[0]) / picture.width);
  const [sx, sy] = [source.width / extent[0], source.height / extent[1]];
  // only the visible part, in whole pixels with a margin of one: at ×64 a picture exceeds the range of canvas coordinates
  /** @param {number} scale @param {number} at @param {number} room @param {number} whole */
  const span = (at, room, scale, whole) => {
    const first = Math.max(0, Math.floor((-at / viewport.zoom) * scale) - 1);
    const last = Math.min(whole, Math.ceil(((room - at) / viewport.zoom) * scale) + 1);
    return [first, last - first];
  };
  const [left, width] = span(viewport.x, size[0], sx, source.width);
  const [top, height] = span(viewport.y, size[1], sy, source.height);
  if (width <= 0 || height <= 0) return;
  context.imageSmoothingEnabled = smooth;
  context.imageSmoothingQuality = "medium";
  const [x, y] = [viewport.x + (left / sx) * viewport.zoom, viewport.y + (top / sy) * viewport.zoom];
  context.drawImage(source, left, top, width, height, x, y, (width / sx) * viewport.zoom, (height / sy) * viewport.zoom);
  if (finer) drawParts(context, viewport, size, extent, finer);
};

/**
 * @param {CanvasRenderingContext2D} context
 * @param {Viewport} viewport
 * @param {readonly number[]} size
 * @param {readonly number[]} extent
 * @param {{parts: PictureParts, viewer: string}} finer
 */
const drawParts = (context, viewport, size, extent, { parts, viewer }) => {
  const { zoom, x, y } = viewport;
  const region = [-x / zoom, -y / zoom, (size[0] - x) / zoom, (size[1] - y) / zoom];
  for (const { bitmap, left, top, width, height } of parts.within(viewer, region, zoom * (window.devicePixelRatio || 1))) {
    context.drawImage(bitmap, x + left * zoom, y + top * zoom, width * zoom, height * zoom);
  }
};
