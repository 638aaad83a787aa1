/**
 * Arithmetic of the overview strip: an equirectangular picture of the full turn, whose left and right borders look
 * backwards and whose middle looks ahead (X of the scanner frame; Y left, Z up). No DOM.
 */

import { axisOf, pixelOf } from "./projection.js";

const TURN = 2 * Math.PI;
const HYSTERESIS_RAD = 0.1;
const FAR_OFF_RAD = 0.6;

/** @typedef {{low: number, high: number}} Extent elevations of the lower and upper border, rad */

/** @param {number} angle @returns {number} an angle within a half turn of 0 */
export const wrapped = (angle) => angle - TURN * Math.round(angle / TURN);

/** @param {readonly number[]} ray @returns {[number, number]} its azimuth (left positive) and elevation, rad */
export const anglesOf = ([x, y, z]) => [Math.atan2(y, x), Math.atan2(z, Math.hypot(x, y))];

/** @param {number} azimuth @param {number} elevation @returns {number[]} the unit ray of an azimuth and an elevation */
export const rayAt = (azimuth, elevation) => [
  Math.cos(elevation) * Math.cos(azimuth),
  Math.cos(elevation) * Math.sin(azimuth),
  Math.sin(elevation),
];

/**
 * @param {Extent} extent
 * @param {readonly number[]} size width and height of the strip
 * @param {readonly number[]} angles azimuth and elevation
 * @returns {[number, number]} their position in the strip
 */
export const positionOf = (extent, size, [azimuth, elevation]) => [
  size[0] * (0.5 - azimuth / TURN),
  (size[1] * (extent.high - elevation)) / (extent.high - extent.low),
];

/**
 * @param {Extent} extent
 * @param {readonly number[]} size
 * @param {readonly number[]} at
 * @returns {[number, number]} azimuth and elevation at a position; beyond a border it wraps, or stays at the edge
 */
export const anglesAt = (extent, size, [x, y]) => [
  wrapped(TURN * (0.5 - x / size[0])),
  extent.high - (extent.high - extent.low) * Math.min(1, Math.max(0, y / size[1])),
];

/**
 * @param {number[][]} rays a closed outline
 * @param {Extent} extent
 * @param {readonly number[]} size
 * @returns {{points: number[][], turns: boolean}} its positions without jumps at the seam, possibly beyond the borders.
 *   `turns`: it goes once around a pole, and is closed beyond the strip's border at that pole
 */
export const outlineIn = (rays, extent, size) => {
  const angles = rays.map(anglesOf);
  const unrolled = angles.map(([, elevation]) => [0, elevation]);
  let azimuth = angles[0]?.[0] ?? 0;
  angles.forEach(([next], k) => {
    azimuth += wrapped(next - azimuth);
    unrolled[k][0] = azimuth;
  });
  const points = unrolled.map((each) => positionOf(extent, size, each));
  const closing = angles.length ? azimuth + wrapped(angles[0][0] - azimuth) : azimuth;
  const turns = angles.length > 0 && Math.abs(closing - unrolled[0][0]) > Math.PI;
  if (turns) {
    const up = unrolled.reduce((sum, [, elevation]) => sum + elevation, 0) > 0;
    const beyond = up ? -size[1] : 2 * size[1];
    const end = positionOf(extent, size, [closing, unrolled[0][1]]);
    points.push(end, [end[0], beyond], [points[0][0], beyond]);
  }
  return { points, turns };
};

/** @param {number[][]} rays @returns {number[] | null} the unit ray amid an outline; null without one */
export const amid = (rays) => {
  const sum = rays.reduce((total, ray) => total.map((value, k) => value + ray[k]), [0, 0, 0]);
  const length = Math.hypot(...sum);
  return length > 1e-6 ? sum.map((value) => value / length) : null;
};

/** @param {readonly number[]} a @param {readonly number[]} b @returns {number} the angle between two unit rays */
export const angleBetween = (a, b) => Math.acos(Math.min(1, Math.max(-1, a[0] * b[0] + a[1] * b[1] + a[2] * b[2])));

/**
 * @param {import("./projection.js").ScanView[]} views
 * @param {number[]} ray
 * @param {number} present index of the shown view, kept unless another is clearly more central
 * @param {boolean} turning whether one looks on, so that the view is kept until the ray is far from its middle: each is
 *   another picture
 * @returns {number} index of the view that shows a ray nearest its middle
 */
export const viewTowards = (views, ray, present, turning = false) => {
  const off = views.map((view) => angleBetween(axisOf(view), ray));
  const best = off.indexOf(Math.min(...off));
  const seen = views[present] && pixelOf(views[present], ray);
  const stays = off[present] < (turning ? FAR_OFF_RAD : off[best] + HYSTERESIS_RAD);
  return seen && stays ? present : best;
};

/** @param {number} at @param {number} room @param {number} length */
const nearBorder = (at, room, length) => (length <= room ? (room - length) / 2 : Math.min(0, Math.max(at, room - length)));

/**
 * @param {import("./viewport.js").Viewport} viewport
 * @param {readonly number[]} pane
 * @param {readonly number[]} picture
 * @returns {import("./viewport.js").Viewport} moved so that the picture fills the pane, as far as it is large enough
 */
export const filling = ({ zoom, x, y }, pane, picture) => ({
  zoom,
  x: nearBorder(x, pane[0], picture[0] * zoom),
  y: nearBorder(y, pane[1], picture[1] * zoom),
});

/** @param {readonly number[]} angles @returns {string} a direction as the views are labelled, with its elevation */
export const directionLabel = ([azimuth, elevation]) => {
  const [across, up] = [azimuth, elevation].map((angle) => Math.round((angle * 180) / Math.PI));
  const side = across === 0 ? "ahead" : Math.abs(across) === 180 ? "behind" : `${Math.abs(across)} deg ${across > 0 ? "left" : "right"}`;
  return up === 0 ? side : `${side}, ${Math.abs(up)} ${up > 0 ? "up" : "down"}`;
};

/** @param {readonly number[]} angles @returns {string} a direction in words */
export const directionSaid = ([azimuth, elevation]) => {
  const [across, up] = [azimuth, elevation].map((angle) => Math.round((angle * 180) / Math.PI));
  const side = across === 0 ? "ahead" : Math.abs(across) === 180 ? "behind" : `${Math.abs(across)} degrees ${across > 0 ? "left" : "right"}`;
  return up === 0 ? side : `${side}, ${Math.abs(up)} degrees ${up > 0 ? "up" : "down"}`;
};

/**
 * Take room for a box if it covers none that was taken before.
 * @param {number[][]} taken left, top, right, bottom of each; the box is added
 * @param {number[]} box
 * @returns {boolean} whether there was room
 */
export const takesRoom = (taken, box) => {
  const [left, top, right, bottom] = box;
  if (taken.some(([l, t, r, b]) => left < r && l < right && top < b && t < bottom)) return false;
  taken.push(box);
  return true;
};
