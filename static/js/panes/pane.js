/** A pane: stacked canvases, the viewport of the picture, and which layers need redrawing. */

import { drawing } from "../ui/canvas.js";
import { allowed, between, fitted, inside, keptInSight, moved, toPixel, toScreen, zoomedAbout } from "./viewport.js";

/** @typedef {import("./viewport.js").Viewport} Viewport */

/** @typedef {"picture" | "compare" | "matches" | "live"} Layer */

/** @type {Layer[]} */
const LAYERS = ["picture", "compare", "matches", "live"];
/**
 * Layers of many strokes are rasterised by the CPU, which `willReadFrequently` requests: 500 matches take about 10 ms
 * there, and seconds in a software graphics driver, as on remote desktops.
 */
const ON_CPU = new Set(["matches", "live"]);
const GLIDE_MS = 220;

const reducedMotion = matchMedia("(prefers-reduced-motion: reduce)");

/** @returns {boolean} whether animations are allowed */
export const motionAllowed = () => !reducedMotion.matches;

/**
 * Let only boxes be drawn to, in whole pixels of the canvas: parts of one would be drawn over what is there.
 * @param {CanvasRenderingContext2D} context
 * @param {number[][]} boxes
 * @param {number} ratio
 */
const clipTo = (context, boxes, ratio) => {
  context.beginPath();
  for (const [left, top, right, bottom] of boxes) {
    const [x, y] = [Math.floor(left * ratio), Math.floor(top * ratio)];
    context.rect(x, y, Math.ceil(right * ratio) - x, Math.ceil(bottom * ratio) - y);
  }
  context.clip();
};

/** @typedef {"hand" | "link" | "page" | "strip"} Mover who moved the picture: the operator, here or in the strip; the linked pane; the page */

/** @typedef {{from: import("./viewport.js").Viewport, to: import("./viewport.js").Viewport, by: Mover, began: number}} Glide */

/** A pane and its layers. */
export class Pane {
  /** @type {import("./viewport.js").Viewport} */
  viewport = { zoom: 1, x: 0, y: 0 };
  /** @type {readonly number[]} CSS pixels */
  size = [0, 0];
  /** @type {readonly number[] | null} width and height of the picture, its own pixels */
  extent = null;
  /** @type {Map<Layer, CanvasRenderingContext2D>} */
  #contexts = new Map();
  /** @type {Set<Layer>} */
  #dirty = new Set();
  #emptied = new Set(LAYERS);
  #frame = 0;
  #fits = true;
  /** @type {Glide | null} */
  #glide = null;
  /** @type {Set<(pane: Pane, by: Mover) => void>} */
  #listeners = new Set();
  #paint;
  #measured = { began: 0, spent_ms: 0 };

  /**
   * @param {HTMLElement} body
   * @param {"scan" | "photo"} side
   * @param {Record<Layer, Painter | PartPainter>} paint one painter for each layer
   *
   * @typedef {{changed: () => number[][] | null, draw: Painter}} PartPainter states which places have changed since it
   *   was asked before: left, top, right, bottom, CSS pixels; null: all of it
   * @typedef {(context: CanvasRenderingContext2D, boxes?: number[][] | null) => boolean | void} Painter false: the
   *   layer is empty
   */
  constructor(body, side, paint) {
    this.body = body;
    this.side = side;
    this.#paint = paint;
    for (const layer of LAYERS) {
      const canvas = document.createElement("canvas");
      canvas.className = `pane-layer pane-${layer}`;
      canvas.setAttribute("aria-hidden", "true");
      body.append(canvas);
      this.#contexts.set(layer, drawing(canvas.getContext("2d", { willReadFrequently: ON_CPU.has(layer) })));
    }
    new ResizeObserver(() => this.#resize()).observe(body);
    this.#watchRatio();
  }

  /** A window moved to another screen may change its pixel ratio without changing its size. */
  #watchRatio() {
    matchMedia(`(resolution: ${window.devicePixelRatio}dppx)`).addEventListener("change", () => {
      this.#resize();
      this.#watchRatio();
    }, { once: true });
  }

  #resize() {
    const size = [this.body.clientWidth, this.body.clientHeight];
    const ratio = window.devicePixelRatio || 1;
    for (const { canvas } of this.#contexts.values()) {
      canvas.width = Math.max(1, Math.round(size[0] * ratio));
      canvas.height = Math.max(1, Math.round(size[1] * ratio)); // which empties it
      // not 100 %: a body of fractional width would stretch the picture under the pointer
      canvas.style.setProperty("width", `${canvas.width / ratio}px`);
      canvas.style.setProperty("height", `${canvas.height / ratio}px`);
    }
    for (const layer of LAYERS) this.#emptied.add(layer);
    const before = this.size;
    this.size = size;
    if (this.extent && size[0] > 0 && size[1] > 0) {
      if (this.#fits || before[0] === 0) this.fit("page");
      else this.place(moved(this.viewport, [(size[0] - before[0]) / 2, (size[1] - before[1]) / 2]), "page");
    }
    this.invalidate(...LAYERS);
    this.#draw(); // in this frame: a resized canvas is empty
  }

  /**
   * Set the size of the picture; zoom and position stay if it has not changed.
   * @param {readonly number[] | null} extent
   */
  setExtent(extent) {
    const same = extent && this.extent && extent[0] === this.extent[0] && extent[1] === this.extent[1];
    this.extent = extent;
    // the observer reports the first size after the first frame; a press may come before it
    if (this.size[0] === 0) this.size = [this.body.clientWidth, this.body.clientHeight];
    if (extent && !same) this.fit("page");
    this.invalidate(...LAYERS);
    for (const listen of this.#listeners) listen(this, "page");
  }

  /** Redraw layers in the next frame. @param {...Layer} layers */
  invalidate(...layers) {
    for (const layer of layers) this.#dirty.add(layer);
    if (!this.#frame) this.#frame = requestAnimationFrame((now) => this.#step(now));
  }

  /** @param {number} now */
  #step(now) {
    this.#frame = 0;
    if (this.#glide) this.#glideOn(this.#glide, now);
    this.#draw();
  }

  #draw() {
    const began = performance.now();
    const ratio = window.devicePixelRatio || 1;
    for (const [layer, context] of this.#contexts) {
      if (!this.#dirty.delete(layer)) continue;
      const paint = this.#paint[layer];
      const [draw, changed] = typeof paint === "function" ? [paint, null] : [paint.draw, paint.changed()];
      const boxes = this.#emptied.delete(layer) ? null : changed;
      if (boxes?.length === 0) continue;
      context.save();
      context.setTransform(1, 0, 0, 1, 0, 0);
      if (boxes) clipTo(context, boxes, ratio);
      context.clearRect(0, 0, context.canvas.width, context.canvas.height);
      context.setTransform(ratio, 0, 0, ratio, 0, 0);
      // an empty layer is hidden: compositing it costs time in each frame
      context.canvas.hidden = draw(context, boxes) === false;
      context.restore();
    }
    if (this.#measured.began) {
      const spent = this.#measured.spent_ms + performance.now() - began;
      performance.clearMeasures("pane move");
      performance.measure("pane move", { start: this.#measured.began, duration: spent });
      this.#measured = { began: 0, spent_ms: 0 };
    }
  }

  /** Record the cost of a pointer move before its drawing: both add up to the measure `pane move`. @param {number} began_ms */
  noteMove(began_ms) {
    this.#measured.began ||= began_ms;
    this.#measured.spent_ms += performance.now() - began_ms;
  }

  /** @param {(pane: Pane, by: Mover) => void} listen called when the viewport changes */
  onMove(listen) {
    this.#listeners.add(listen);
  }

  /**
   * Set the viewport, limited so that some of the picture stays visible.
   * @param {import("./viewport.js").Viewport} viewport
   * @param {Mover} by
   */
  place(viewport, by) {
    this.#glide = null;
    this.#fits = false;
    this.#put(viewport, by);
  }

  /** @param {Viewport} viewport @param {Mover} by */
  #put(viewport, by) {
    this.viewport = this.extent ? keptInSight(viewport, this.size, this.extent) : viewport;
    this.invalidate(...LAYERS);
    for (const listen of this.#listeners) listen(this, by);
  }

  /** Fit the whole picture. @param {Mover} by */
  fit(by) {
    if (!this.extent || this.size[0] === 0) return;
    this.place(fitted(this.size, this.extent), by);
    this.#fits = true;
  }

  /**
   * Zoom, in screen pixels per image pixel; the point at xy (by default the centre) stays in place.
   * @param {number} zoom
   * @param {Mover} by
   */
  zoomTo(zoom, by, xy = [this.size[0] / 2, this.size[1] / 2]) {
    if (!this.extent) return;
    const at = zoomedAbout(this.viewport, xy, allowed(zoom, this.size, this.extent));
    // One to one, a pixel of the picture is a pixel of the screen, not parts of four.
    this.place(at.zoom === 1 ? { zoom: 1, x: Math.round(at.x), y: Math.round(at.y) } : at, by);
  }

  /** @returns {number} zoom relative to that at which the whole picture fits */
  get relativeZoom() {
    return this.extent ? this.viewport.zoom / fitted(this.size, this.extent).zoom : 1;
  }

  /** Move to a viewport, animated if motion is allowed. @param {Viewport} viewport @param {Mover} by */
  glideTo(viewport, by) {
    if (!motionAllowed() || viewport === this.viewport) return this.place(viewport, by);
    this.#glide = { from: this.viewport, to: viewport, by, began: performance.now() };
    this.#fits = false;
    return this.invalidate("live");
  }

  /** @param {Glide} glide @param {number} now */
  #glideOn({ from, to, by, began }, now) {
    const t = Math.max(0, Math.min(1, (now - began) / GLIDE_MS));
    this.#put(between(from, to, 1 - (1 - t) ** 3, this.size), by);
    if (t >= 1) this.#glide = null;
  }

  /** @param {{clientX: number, clientY: number}} event @returns {[number, number]} position of an event, CSS pixels of the pane */
  at(event) {
    const box = this.body.getBoundingClientRect();
    return [event.clientX - box.left - this.body.clientLeft, event.clientY - box.top - this.body.clientTop];
  }

  /**
   * @param {readonly number[]} xy
   * @returns {[number, number]} the image pixel at a position of the pane, clamped to the picture, if there is one
   */
  pixelAt(xy) {
    const uv = toPixel(this.viewport, xy);
    return this.extent ? inside(uv, this.extent) : uv;
  }

  /** @param {readonly number[]} uv @returns {[number, number]} position of an image pixel, CSS pixels of the pane */
  screenOf(uv) {
    return toScreen(this.viewport, uv);
  }
}
