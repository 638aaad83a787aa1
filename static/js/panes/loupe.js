/** The loupe: an enlarged view of the pixels under the pointer, placed so that it covers nothing that matters. */

import { drawing } from "../ui/canvas.js";
import { toScreen } from "./viewport.js";

/** @typedef {import("./viewport.js").Viewport} Viewport */

export const RADIUS_PX = 66;
const TIMES = 5;
const MIN_ZOOM = 6;
const MAX_ZOOM = 320;
const CLEAR_PX = 22;
const CAPTION_PX = 24;
const LABEL_SHARE = 0.58;

/** @param {number} zoom @returns {number} the loupe's zoom at a zoom of the pane */
export const loupeZoom = (zoom) => Math.min(MAX_ZOOM, Math.max(MIN_ZOOM, TIMES * zoom));

/**
 * @param {readonly number[]} xy the enlarged point, CSS pixels of the pane
 * @param {readonly number[]} size of the pane
 * @param {readonly number[] | null} away the other end of the line, which stays clear, too
 * @param {number} scale of symbols
 * @returns {[number, number]} centre of the loupe: above right, elsewhere near borders
 */
export const loupePlace = (xy, size, away = null, scale = 1) => {
  const radius = RADIUS_PX * scale;
  const reach = radius + CLEAR_PX * scale;
  const least = radius + 4;
  /** @type {[number, number][]} */
  const candidates = [[0.75, -0.85], [-0.75, -0.85], [0.75, 0.7], [-0.75, 0.7], [1.05, 0], [-1.05, 0], [0, -1.1], [0, 1]].map(([dx, dy]) => [
    xy[0] + dx * reach,
    xy[1] + dy * reach,
  ]);
  /** @param {[number, number]} centre @param {number} order */
  const cost = ([x, y], order) => {
    /** @param {number} at @param {number} length @param {number} below */
    const over = (at, length, below) => Math.max(0, least - at) + Math.max(0, at + least + below - length);
    const outside = over(x, size[0], 0) + over(y, size[1], CAPTION_PX * scale);
    const covers = away && Math.hypot(away[0] - x, away[1] - y) < radius + 8 ? 40 : 0;
    return outside * 10 + covers + order;
  };
  const costs = candidates.map(cost);
  return candidates[costs.indexOf(Math.min(...costs))];
};

/**
 * @typedef {Pick<import("./colors.js").Look, "scale" | "halo" | "font">} Lettering
 * @typedef {{uv: readonly number[], text: string}} Surface
 */
/** @typedef {(context: CanvasRenderingContext2D, viewport: Viewport, size: readonly number[]) => void} Paint */

/** The loupe of one pane. */
export class Loupe {
  #box = document.createElement("div");
  #caption = document.createElement("output");
  #glass = document.createElement("div");
  #contexts;
  #pane;
  #paint;

  /**
   * @param {import("./pane.js").Pane} pane
   * @param {Paint} picture
   * @param {Paint} over
   */
  constructor(pane, picture, over) {
    this.#pane = pane;
    this.#paint = [picture, over];
    this.#box.className = "loupe";
    this.#box.hidden = true;
    this.#box.setAttribute("aria-hidden", "true"); // the status bar has the same text
    this.#glass.className = "loupe-glass";
    this.#caption.className = "loupe-caption";
    this.#contexts = ["pane-picture", "pane-live"].map((name) => {
      const canvas = document.createElement("canvas");
      canvas.className = name;
      this.#glass.append(canvas);
      return drawing(canvas.getContext("2d", { willReadFrequently: true })); // small, with many strokes
    });
    this.#box.append(this.#glass, this.#caption);
    pane.body.append(this.#box);
  }

  hide() {
    this.#box.hidden = true;
  }

  /**
   * @param {readonly number[]} uv the pixel in the centre
   * @param {readonly number[] | null} away the other end, CSS pixels of the pane
   * @param {string} note below the loupe
   * @param {Lettering} look
   * @param {Surface[]} surfaces of a depth edge, each with what is written towards it
   */
  show(uv, away, note, look, surfaces = []) {
    const { scale } = look;
    const zoom = loupeZoom(this.#pane.viewport.zoom);
    const radius = RADIUS_PX * scale;
    const side = 2 * radius;
    const ratio = window.devicePixelRatio || 1;
    const viewport = { zoom, x: radius - (uv[0] + 0.5) * zoom, y: radius - (uv[1] + 0.5) * zoom };
    this.#contexts.forEach((context, k) => {
      const { canvas } = context;
      if (canvas.width !== Math.round(side * ratio)) canvas.width = canvas.height = Math.round(side * ratio);
      context.setTransform(ratio, 0, 0, ratio, 0, 0);
      context.clearRect(0, 0, side, side);
      this.#paint[k](context, viewport, [side, side]);
    });
    this.#cross(this.#contexts[1], radius, scale);
    for (const surface of surfaces) this.#label(this.#contexts[1], viewport, radius, look, surface);
    const [x, y] = loupePlace(this.#pane.screenOf(uv), this.#pane.size, away, scale);
    this.#box.style.setProperty("transform", `translate(${Math.round(x - radius)}px, ${Math.round(y - radius)}px)`);
    this.#box.style.setProperty("--loupe", `${side}px`);
    this.#caption.textContent = `${uv[0].toFixed(2)}, ${uv[1].toFixed(2)} · ×${zoom.toFixed(zoom < 20 ? 1 : 0)}${note ? ` · ${note}` : ""}`;
    this.#box.hidden = false;
  }

  /**
   * Write a text halfway to the rim, towards a pixel.
   * @param {CanvasRenderingContext2D} context
   * @param {Viewport} viewport
   * @param {number} radius
   * @param {Lettering} look
   * @param {Surface} surface
   */
  #label(context, viewport, radius, { scale, halo, font }, { uv, text }) {
    const [x, y] = toScreen(viewport, uv);
    const length = Math.hypot(x - radius, y - radius);
    if (length < 1) return;
    const [left, top] = [x, y].map((value) => radius + ((value - radius) / length) * LABEL_SHARE * radius);
    context.font = font;
    context.textAlign = "center";
    context.textBaseline = "middle";
    context.lineJoin = "round";
    context.lineWidth = 3.5 * scale;
    context.strokeStyle = halo;
    context.strokeText(text, left, top);
    context.fillStyle = "#ffffff";
    context.fillText(text, left, top);
  }

  /**
   * Draw a thin cross that leaves the centre free.
   * @param {CanvasRenderingContext2D} context
   * @param {number} radius
   * @param {number} scale
   */
  #cross(context, radius, scale) {
    const path = new Path2D();
    for (const [dx, dy] of [[-1, 0], [1, 0], [0, -1], [0, 1]]) {
      path.moveTo(radius + dx * 4 * scale, radius + dy * 4 * scale);
      path.lineTo(radius + dx * 18 * scale, radius + dy * 18 * scale);
    }
    context.lineCap = "butt";
    context.lineWidth = 3;
    context.strokeStyle = "rgba(6, 8, 12, .7)";
    context.stroke(path);
    context.lineWidth = 1;
    context.strokeStyle = "#ffffff";
    context.stroke(path);
  }
}
