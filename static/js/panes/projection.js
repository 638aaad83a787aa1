/**
 * Projection between view pixels and scanner rays. A view is a pinhole camera at the scanner (slice `scan`, `views`);
 * rays are unit vectors of the scanner frame: X forward, Y left, Z up.
 */

/** @typedef {import("../protocol.d.ts").ScanView} ScanView */

const NEAREST = 0.03; // depth of a unit ray along the view's axis: 88 degrees off, far outside any picture

/** @param {ScanView} view @param {readonly number[]} ray @returns {number[]} the ray in the view's frame: right, down, forward */
const rotated = ({ rotation: R }, ray) => [
  R[0] * ray[0] + R[1] * ray[1] + R[2] * ray[2],
  R[3] * ray[0] + R[4] * ray[1] + R[5] * ray[2],
  R[6] * ray[0] + R[7] * ray[1] + R[8] * ray[2],
];

/** @param {ScanView} view @returns {number[]} the unit ray through its middle */
export const axisOf = (view) => view.rotation.slice(6, 9);

/** @param {ScanView} view @param {readonly number[]} seen in the axes of the view @returns {number[]} its pixel */
const projected = (view, [x, y, z]) => [view.cx + (view.f * x) / z, view.cy + (view.f * y) / z];

/**
 * @param {ScanView} view
 * @param {readonly number[]} uv
 * @returns {number[]} the unit ray through a pixel
 */
export const rayOf = (view, uv) => {
  const R = view.rotation;
  const [x, y] = [(uv[0] - view.cx) / view.f, (uv[1] - view.cy) / view.f];
  const length = Math.hypot(x, y, 1);
  return [0, 1, 2].map((k) => (R[k] * x + R[3 + k] * y + R[6 + k]) / length);
};

/**
 * @param {ScanView} view
 * @param {readonly number[]} ray
 * @returns {number[] | null} its pixel, possibly outside the picture; null if the ray is not in front of the view
 */
export const pixelOf = (view, ray) => {
  const seen = rotated(view, ray);
  return seen[2] > NEAREST * Math.hypot(...seen) ? projected(view, seen) : null;
};

/**
 * @param {ScanView} view
 * @param {readonly number[]} a unit ray
 * @param {readonly number[]} b unit ray
 * @returns {number[][] | null} the two ends of the part in front of the view, in pixels; null if there is none
 */
export const segmentOf = (view, a, b) => {
  let [from, to] = [rotated(view, a), rotated(view, b)];
  if (from[2] <= NEAREST && to[2] <= NEAREST) return null;
  /** @param {number[]} behind @param {number[]} front */
  const cut = (behind, front) => {
    const t = (NEAREST - behind[2]) / (front[2] - behind[2]);
    return behind.map((value, k) => value + t * (front[k] - value));
  };
  if (from[2] < NEAREST) from = cut(from, to);
  if (to[2] < NEAREST) to = cut(to, from);
  return [projected(view, from), projected(view, to)];
};

/**
 * @param {ScanView[]} views
 * @param {number[][]} rays
 * @param {number} present index of the shown view, preferred among equals
 * @returns {number} index of the view with the most rays inside its picture
 */
export const viewShowing = (views, rays, present) => {
  /** @param {ScanView} view */
  const shown = (view) => {
    const seen = rays.map((ray) => pixelOf(view, ray));
    return seen.filter((uv) => uv && uv[0] >= 0 && uv[1] >= 0 && uv[0] <= view.width - 1 && uv[1] <= view.height - 1).length;
  };
  const counts = views.map(shown);
  const most = Math.max(...counts);
  return counts[present] === most ? present : counts.indexOf(most);
};
