/**
 * Pictures by address: fetched once, decoded before they are shown, and halved a few times so that a large one can be
 * panned as a whole. While a new one comes, the old one stays.
 */

const KEPT = 10;
const HALVED_ABOVE_PX = 1400;

/** One decoded picture with its halves. */
export class Picture {
  #levels;

  /** @param {ImageBitmap} bitmap */
  constructor(bitmap) {
    this.width = bitmap.width;
    this.height = bitmap.height;
    this.#levels = [bitmap];
  }

  /** Make the halves, each of the one before. */
  async halve() {
    for (;;) {
      const last = this.#levels.at(-1);
      if (Math.max(last.width, last.height) <= HALVED_ABOVE_PX) return;
      const half = { resizeWidth: Math.ceil(last.width / 2), resizeHeight: Math.ceil(last.height / 2), resizeQuality: "medium" };
      this.#levels.push(await createImageBitmap(last, half));
    }
  }

  /** @returns {ImageBitmap} the smallest that still has a pixel for each of the screen; `scale` 1 is full size */
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
    throw new Error("The picture did not come: check that the workbench is running; it is asked for again when the connection is back.");
  }
  if (!answer.ok) {
    const said = (await answer.text()).trim();
    const plain = said && said.length < 300 && !said.startsWith("<");
    throw new Error(plain ? said : `The picture did not come (status ${answer.status}): reload the page.`);
  }
  try {
    return new Picture(await createImageBitmap(await answer.blob()));
  } catch {
    throw new Error("This browser cannot show the picture, which may be too large for it: try another browser or a smaller picture.");
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

/** What one layer shows: the newest picture that has come, of the thing that is wanted. */
export class Slot {
  /** @type {Picture | null} */
  picture = null;
  /** @type {string | null} */
  error = null;
  loading = false;
  #address = null;
  #thing = null;
  #changed;

  /** @param {() => void} changed called when what there is to show, or to say, has changed */
  constructor(changed) {
    this.#changed = changed;
  }

  /**
   * @param {string | null} address null: nothing
   * @param {string | null} thing what it is a picture of; of another thing, the old picture goes at once
   */
  show(address, thing = address) {
    if (address === this.#address && !this.error) return;
    if (thing !== this.#thing) this.picture = null;
    this.#address = address;
    this.#thing = thing;
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
      picture.halve().then(() => address === this.#address && this.#changed(), () => {}); // without halves it is only slower
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
 * Draw the part of a picture that is in sight.
 * @param {CanvasRenderingContext2D} context in CSS pixels of the pane
 * @param {import("./viewport.js").Viewport} viewport
 * @param {readonly number[]} size of the pane
 * @param {Picture} picture
 * @param {readonly number[]} extent width and height that it stands for, in pixels of the thing pictured
 * @param {boolean} smooth
 */
export const drawPicture = (context, viewport, size, picture, extent, smooth) => {
  const ratio = window.devicePixelRatio || 1;
  const source = picture.at((viewport.zoom * ratio * extent[0]) / picture.width);
  const [sx, sy] = [source.width / extent[0], source.height / extent[1]];
  // Only what is seen, in whole pixels with one to spare: a picture at ×64 is wider than canvases reckon with.
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
