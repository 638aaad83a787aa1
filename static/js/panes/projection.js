/**
 * View pixels and rays of the scanner, both ways. A view is a pinhole at the scanner (slice `scan`, `views`); rays are unit
 * vectors of the scanner frame, X forward, Y left, Z up.
 */

/** @typedef {{width: number, height: number, f: number, cx: number, cy: number, rotation: number[], label?: string}} ScanView */

const NEAREST = 0.03; // of a unit ray, along the view's axis: 88 degrees off, where the picture has long ended

/** @returns {number[]} of the ray, in the view: right, down, forward */
const turned = ({ rotation: R }, ray) => [
  R[0] * ray[0] + R[1] * ray[1] + R[2] * ray[2],
  R[3] * ray[0] + R[4] * ray[1] + R[5] * ray[2],
  R[6] * ray[0] + R[7] * ray[1] + R[8] * ray[2],
];

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
 * @returns {number[] | null} its pixel, also outside the picture; null where the ray is not in front of the view
 */
export const pixelOf = (view, ray) => {
  const seen = turned(view, ray);
  return seen[2] > NEAREST * Math.hypot(...seen) ? projected(view, seen) : null;
};

/**
 * @param {ScanView} view
 * @param {readonly number[]} a unit ray
 * @param {readonly number[]} b unit ray
 * @returns {number[][] | null} the two pixels between which the line is drawn: the part in front; null where there is none
 */
export const segmentOf = (view, a, b) => {
  let [from, to] = [turned(view, a), turned(view, b)];
  if (from[2] <= NEAREST && to[2] <= NEAREST) return null;
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
 * @param {number} present index of the view that is shown; it is kept where no other shows more
 * @returns {number} index of the view that shows the most of the rays inside its picture
 */
export const viewShowing = (views, rays, present) => {
  const shown = (view) => {
    const seen = rays.map((ray) => pixelOf(view, ray));
    return seen.filter((uv) => uv && uv[0] >= 0 && uv[1] >= 0 && uv[0] <= view.width - 1 && uv[1] <= view.height - 1).length;
  };
  const counts = views.map(shown);
  const most = Math.max(...counts);
  return counts[present] === most ? present : counts.indexOf(most);
};
