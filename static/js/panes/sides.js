/**
 * The two sides of a match: which picture each pane shows, and its pixels in the workbench's terms (rays, photo
 * pixels).
 */

import { placed } from "./marks.js";
import { pixelOf, rayOf } from "./projection.js";

/**
 * @typedef {import("../net/store.js").Store} Store
 * @typedef {import("../net/store.js").Scan} Scan
 * @typedef {import("../net/store.js").Photo} Photo
 * @typedef {typeof import("../state/view.js").view} View
 */

/** @param {Record<string, string | number | null | undefined>} entries */
const query = (entries) =>
  Object.entries(entries)
    .flatMap(([name, value]) => (value === null || value === undefined ? [] : [`${name}=${encodeURIComponent(value)}`]))
    .join("&");

/**
 * @param {Scan | null} scan
 * @param {import("../state/view.js").ViewState["scan"]} display
 * @returns {import("./picture_stretch.js").Stretch} the channel that is shown, and its contrast
 */
const stretchOf = (scan, { show, low, high, equalise, gamma }) => {
  const dark = scan?.has_intensity === false;
  const unavailable = (show === "color" && !scan?.has_color) || (dark && ["intensity", "raw"].includes(show));
  const usual = dark ? "shape" : "intensity";
  return { show: unavailable ? usual : show, low, high, equalise, gamma };
};

/**
 * @param {Scan | null} scan
 * @param {number} index of one of its views
 * @param {import("../state/view.js").ViewState["scan"]} display
 * @returns {string} URL of the picture
 */
export const scanAddress = (scan, index, display) => {
  const { show, low, high, equalise, gamma } = stretchOf(scan, display);
  return `picture/scan?${query({ view: index, show, low, high, equalise: equalise ? 1 : 0, gamma, rev: scan?.id })}`;
};

/** The side of the scan, shown in one of its views. */
export class ScanSide {
  name = /** @type {const} */ ("scan");
  #store;
  #view;

  /** @param {Store} store @param {View} view */
  constructor(store, view) {
    this.#store = store;
    this.#view = view;
  }

  /** @returns {Scan | null} slice `scan`, or `beside` where another station's is shown */
  get scan() {
    return this.#store.scanBeside();
  }

  /** @returns {string} id of the station whose scan it is; empty: the project's */
  get station() {
    return this.#store.station();
  }

  /** @returns {number} index of the shown view */
  get index() {
    const count = this.scan?.views?.length ?? 0;
    return Math.max(0, Math.min(this.#view.get().scan.view, count - 1));
  }

  /** @returns {import("./projection.js").ScanView | null} */
  get lens() {
    return this.scan?.views?.[this.index] ?? null;
  }

  /** @returns {number[] | null} width and height of the picture */
  get extent() {
    return this.lens && [this.lens.width, this.lens.height];
  }

  /** @returns {string | null} which scan it is, whatever becomes of its ranges */
  get id() {
    return this.scan?.grid ?? this.scan?.id ?? null;
  }

  /** @returns {string | null} identifies what is pictured */
  get subject() {
    return this.scan && `${this.scan.id}/${this.index}`;
  }

  /** @param {readonly number[]} uv @returns {number[]} the ray through a pixel */
  toWorld(uv) {
    const { lens } = this;
    if (!lens) throw new Error("There is no scan in the pane: strokes begin and end where there is one.");
    return rayOf(lens, uv);
  }

  /**
   * @param {number[]} ray
   * @returns {number[] | null} the pixel of a ray; null: it is not in front of the view, or there is no scan
   */
  toPixel(ray) {
    const { lens } = this;
    return lens && pixelOf(lens, ray);
  }

  /** @param {number[][]} ends @returns {{ends: (number[] | null)[], line: number[][] | null}} in pixels */
  placed(ends) {
    return placed(ends, this.lens);
  }

  /** @returns {string | null} URL of the picture */
  get address() {
    return this.lens ? scanAddress(this.scan, this.index, this.#view.get().scan) : null;
  }

  /** @returns {import("./picture_stretch.js").Stretch} the channel that is shown, and its contrast */
  get stretch() {
    return stretchOf(this.scan, this.#view.get().scan);
  }

  /** @returns {string | null} a note over the picture */
  get note() {
    const byShape = this.lens && this.scan?.has_intensity === false && this.stretch.show === "shape";
    return byShape ? "No intensity in this scan: shown by its shape." : null;
  }

  /** @returns {string | null} what to do while there is no picture */
  get empty() {
    return this.lens ? null : "No scan yet. Open one, or drop a file anywhere on this page.";
  }
}

/** The side of the photograph. */
export class PhotoSide {
  name = /** @type {const} */ ("photo");
  lens = null;
  stretch = null;
  #store;
  #view;

  /** @param {Store} store @param {View} view */
  constructor(store, view) {
    this.#store = store;
    this.#view = view;
  }

  /** @returns {Photo | null} entry of slice `photos` */
  get photo() {
    return this.#store.photo();
  }

  get extent() {
    return this.photo && [this.photo.width, this.photo.height];
  }

  get id() {
    return this.photo?.id ?? null;
  }

  get subject() {
    return this.id;
  }

  /** @param {readonly number[]} uv */
  toWorld(uv) {
    return [uv[0], uv[1]];
  }

  /** @param {number[]} uv */
  toPixel(uv) {
    return uv;
  }

  /** @param {number[][]} ends */
  placed(ends) {
    return placed(ends, null);
  }

  get address() {
    if (!this.photo) return null;
    const { id, rev } = this.photo;
    return `picture/photo/${encodeURIComponent(id)}?${query({ rev: rev ?? id })}`;
  }

  /** @returns {string | null} URL of the scan projected into this photograph under the shown pose, or that of
   *   a camera that is being placed by hand */
  get overlayAddress() {
    const stage = this.#store.stageOf();
    const { placement, photo: { overlay } } = this.#view.get();
    if (this.photo && placement?.photo === this.photo.id) {
      const pose = placement.pose.slice(0, 3).flat().map((value) => value.toFixed(7)).join(",");
      const show = overlay === "edges" ? "edges" : "intensity";
      return `picture/overlay/${encodeURIComponent(this.photo.id)}?${query({ pose, show, rev: this.#store.scanBeside()?.id })}`;
    }
    if (!this.photo || !stage || overlay === "none") return null;
    // a stage may be solved again with another result
    const rev = [...(stage.centre ?? []), stage.cost, stage.focal_px, ...(stage.parameters ?? []).map(({ value }) => value)].join(" ");
    const show = overlay === "edges" ? "edges" : "intensity";
    return `picture/overlay/${encodeURIComponent(this.photo.id)}?${query({ stage: stage.stage, show, rev })}`;
  }

  get empty() {
    return this.photo ? null : "No photograph yet. Add one with +, or drop a file anywhere on this page.";
  }

  /** @returns {string | null} a note over the picture */
  get note() {
    return this.photo && !this.photo.camera
      ? "Focal length unknown. Matches can be drawn, but solving needs it: enter it next to the photograph's name above."
      : null;
  }
}
