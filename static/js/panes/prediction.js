/** The tick that accepts a predicted partner: at the middle of the line, or beside the point. */

import { distanceToSegment, LINE_PX } from "./hits.js";
import { RING_PX } from "./match_layer.js";
import { strokeHaloed } from "./symbols.js";
import { toScreen } from "./viewport.js";

/**
 * @typedef {import("./viewport.js").Viewport} Viewport
 * @typedef {import("./colors.js").Look} Look
 */

const TICK_PX = 9;
const BESIDE_PX = 17;
const CLEAR_OF_ENDS_PX = 14;

/** @typedef {{ends: (number[] | null)[], line: number[][] | null}} Placed in pixels */

/**
 * @param {Placed} placed
 * @param {import("./viewport.js").Viewport} viewport
 * @param {number} scale of symbols
 * @returns {number[] | null} position of the tick, CSS pixels of the pane
 */
export const tickPosition = ({ ends, line }, viewport, scale) => {
  if (line) {
    const [a, b] = line.map((uv) => toScreen(viewport, uv));
    return [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2];
  }
  const at = ends[0] && toScreen(viewport, ends[0]);
  return at && [at[0] + BESIDE_PX * scale, at[1] - BESIDE_PX * scale];
};

/**
 * Presses near a line's ends do not accept it: there, a better line is begun by hand.
 * @param {Placed} placed
 * @param {Viewport} viewport
 * @param {readonly number[]} xy
 * @param {number} scale
 * @returns {boolean} whether a press at xy accepts
 */
export const accepts = (placed, viewport, xy, scale) => {
  const tick = tickPosition(placed, viewport, scale);
  if (!tick) return false;
  if (Math.hypot(tick[0] - xy[0], tick[1] - xy[1]) <= (TICK_PX + 2) * scale) return true;
  if (!placed.line) return false;
  const [a, b] = placed.line.map((uv) => toScreen(viewport, uv));
  const clear = [a, b].every((end) => Math.hypot(end[0] - xy[0], end[1] - xy[1]) > (CLEAR_OF_ENDS_PX + RING_PX) * scale);
  return clear && distanceToSegment(xy, a, b) <= LINE_PX * scale;
};

/**
 * Draw the tick.
 * @param {CanvasRenderingContext2D} context
 * @param {Placed} placed
 * @param {Viewport} viewport
 * @param {Look} look
 * @param {string} colour
 */
export const drawTick = (context, placed, viewport, look, colour) => {
  const { scale } = look;
  const at = tickPosition(placed, viewport, scale);
  if (!at) return;
  const [disc, tick] = [new Path2D(), new Path2D()];
  disc.arc(at[0], at[1], TICK_PX * scale, 0, 2 * Math.PI);
  tick.moveTo(at[0] - 4 * scale, at[1]);
  tick.lineTo(at[0] - scale, at[1] + 3.5 * scale);
  tick.lineTo(at[0] + 4.5 * scale, at[1] - 3.5 * scale);
  context.fillStyle = look.halo;
  context.fill(disc);
  strokeHaloed(context, disc, look, { colour, width: 1.5 });
  context.lineWidth = 2 * scale;
  context.strokeStyle = look.ink;
  context.stroke(tick);
};
