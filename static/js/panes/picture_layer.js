/**
 * Pictures by URL: fetched once, decoded before they are shown, with reduced levels so that large ones pan smoothly.
 * While a new one loads, the old one stays.
 */

const KEPT = 10;
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
      const last = this.#levels.at(-1);
      if (Math.max(last.width, last.height) <= HALVED_ABOVE_PX) return;
      const half = { resizeWidth: Math.ceil(last.width / 2), resizeHeight: Math.ceil(last.height / 2), resizeQuality: "medium" };
      this.#levels.push(await createImageBitmap(last, half));
    }
  }

  /** @returns {ImageBitmap} the smallest level that still has one pixel per screen pixel; `scale` 1 is full size */
  at(scale) {
    const step = Math.max(0, Math.floor(-Math.log2(Math.max(scale, 1e-6)) + 1e-6));
    return this.#levels[Math.min(step, this.#levels.length - 1)];
  }
}

const cache = new Map();

const decoded = async (address) => {
  let answer;
  try {
    answer = await fetch(address);
  } catch {
    throw new Error("The picture could not be loaded: check that the workbench is running. It is loaded again when the connection is back.");
  }
  if (!answer.ok) {
    const text = (await answer.text()).trim();
    const plain = text && text.length < 300 && !text.startsWith("<");
    throw new Error(plain ? text : `The picture could not be loaded (status ${answer.status}): reload the page.`);
  }
  try {
    return new Picture(await createImageBitmap(await answer.blob()));
  } catch {
    throw new Error("This browser cannot decode the picture, which may be too large for it: use another browser or a smaller picture.");
  }
};

/**
 * @param {string} address relative to the page
 * @returns {Promise<Picture>} rejects with an Error whose message is one sentence
 */
export const loadPicture = (address) => {
  const known = cache.get(address);
  cache.delete(address);
  const picture = known ?? decoded(address);
  cache.set(address, picture);
  picture.catch(() => cache.get(address) === picture && cache.delete(address));
  for (const oldest of cache.keys()) {
    if (cache.size <= KEPT) break;
    cache.delete(oldest);
  }
  return picture;
};

/** The picture of one layer: the newest that has loaded of its subject. */
export class Slot {
  /** @type {Picture | null} */
  picture = null;
  /** @type {string | null} */
  error = null;
  loading = false;
  #address = null;
  #subject = null;
  #changed;

  /** @param {() => void} changed called when the picture, its error or its loading state has changed */
  constructor(changed) {
    this.#changed = changed;
  }

  /**
   * @param {string | null} address null for no picture
   * @param {string | null} subject what is pictured; when it changes, the old picture disappears at once
   */
  show(address, subject = address) {
    if (address === this.#address && !this.error) return;
    if (subject !== this.#subject) this.picture = null;
    this.#address = address;
    this.#subject = subject;
    this.error = null;
    this.loading = address !== null;
    if (address === null) this.picture = null;
    this.#changed();
    if (address !== null) this.#load(address);
  }

  async #load(address) {
    try {
      const picture = await loadPicture(address);
      if (address !== this.#address) return;
      this.picture = picture;
      picture.halve().then(() => address === this.#address && this.#changed(), () => {}); // without levels it is only slower
    } catch (error) {
      if (address !== this.#address) return;
      this.error = error.message;
      this.picture = null;
    }
    this.loading = false;
    this.#changed();
  }
}

/**
 * Draw the visible part of a picture.
 * @param {CanvasRenderingContext2D} context in CSS pixels of the pane
 * @param {import("./viewport.js").Viewport} viewport
 * @param {readonly number[]} size of the pane
 * @param {Picture} picture
 * @param {readonly number[]} extent width and height that the picture represents, in pixels of the view or photograph
 * @param {boolean} smooth
 */
export const drawPicture = (context, viewport, size, picture, extent, smooth) => {
  const ratio = window.devicePixelRatio || 1;
  const source = picture.at((viewport.zoom * ratio * extent[0]) / picture.width);
  const [sx, sy] = [source.width / extent[0], source.height / extent[1]];
  // only the visible part, in whole pixels with a margin of one: at ×64 a picture exceeds the range of canvas coordinates
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
};
