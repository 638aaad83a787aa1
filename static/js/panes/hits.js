/** Hit tests: ends before lines, selected matches before others, the nearest first. */

import { toScreen } from "./viewport.js";

/**
 * @typedef {{id: string, index: number | null, distance: number}} Hit `index` of the end; null for the line between
 */

export const END_PX = 9;
export const LINE_PX = 6;

/**
 * @param {readonly number[]} p
 * @param {readonly number[]} a
 * @param {readonly number[]} b
 * @returns {number} distance of a point from the segment ab
 */
export const distanceToSegment = (p, a, b) => {
  const [dx, dy] = [b[0] - a[0], b[1] - a[1]];
  const squared = dx * dx + dy * dy;
  const t = squared > 0 ? Math.min(1, Math.max(0, ((p[0] - a[0]) * dx + (p[1] - a[1]) * dy) / squared)) : 0;
  return Math.hypot(p[0] - a[0] - t * dx, p[1] - a[1] - t * dy);
};

/** @template {{distance: number}} Found @param {Found | null} best @param {Found} hit @returns {Found} */
const nearer = (best, hit) => (!best || hit.distance < best.distance ? hit : best);

/**
 * Find the match under the pointer.
 * @param {import("./marks.js").Mark[]} marks
 * @param {import("./viewport.js").Viewport} viewport
 * @param {readonly number[]} xy CSS pixels of the pane
 * @param {ReadonlySet<string>} selected
 * @param {number} scale of symbols
 * @returns {Hit | null}
 */
export const hitAt = (marks, viewport, xy, selected = new Set(), scale = 1) => {
  /** @type {Record<"end" | "selectedEnd" | "line" | "selectedLine", Hit | null>} */
  const found = { end: null, selectedEnd: null, line: null, selectedLine: null };
  for (const mark of marks) {
    const prefix = selected.has(mark.id) ? "selected" : "";
    mark.ends.forEach((uv, index) => {
      if (!uv) return;
      const [x, y] = toScreen(viewport, uv);
      const distance = Math.hypot(x - xy[0], y - xy[1]);
      const name = prefix ? "selectedEnd" : "end";
      if (distance <= END_PX * scale) found[name] = nearer(found[name], { id: mark.id, index, distance });
    });
    if (!mark.line) continue;
    const distance = distanceToSegment(xy, toScreen(viewport, mark.line[0]), toScreen(viewport, mark.line[1]));
    const name = prefix ? "selectedLine" : "line";
    if (distance <= LINE_PX * scale) found[name] = nearer(found[name], { id: mark.id, index: null, distance });
  }
  return found.selectedEnd ?? found.end ?? found.selectedLine ?? found.line;
};

/**
 * Find the measurement under the pointer.
 * @param {ReturnType<typeof import("./measured_layer.js").measuredMarks>} marks
 * @param {import("./viewport.js").Viewport} viewport
 * @param {readonly number[]} xy CSS pixels of the pane
 * @param {number} scale of symbols
 * @returns {string | null} its id
 */
export const measurementAt = (marks, viewport, xy, scale = 1) => {
  /** @type {{id: string, distance: number} | null} */
  let best = null;
  /** @param {number[] | null} uv */
  const on = (uv) => uv && toScreen(viewport, uv);
  for (const { id, ends, lines } of marks) {
    const pairs = lines.flatMap((line) => line.slice(1).map((end, k) => [on(line[k]), on(end)]));
    const distances = [
      ...ends.map((uv) => Math.hypot(...toScreen(viewport, uv).map((at, k) => at - xy[k])) - (END_PX - LINE_PX) * scale),
      ...pairs.flatMap(([a, b]) => (a && b ? [distanceToSegment(xy, a, b)] : [])),
    ];
    const distance = Math.min(...distances);
    if (distance <= LINE_PX * scale) best = nearer(best, { id, distance });
  }
  return best?.id ?? null;
};

/**
 * @param {import("./marks.js").Mark[]} marks
 * @param {readonly number[]} a pixel
 * @param {readonly number[]} b pixel
 * @returns {string[]} ids of the matches with all visible ends inside the rectangle between the two
 */
export const within = (marks, a, b) => {
  /** @param {readonly number[]} uv */
  const inside = (uv) =>
    uv[0] >= Math.min(a[0], b[0]) && uv[0] <= Math.max(a[0], b[0]) && uv[1] >= Math.min(a[1], b[1]) && uv[1] <= Math.max(a[1], b[1]);
  return marks.filter(({ ends }) => ends.some(Boolean) && ends.every((uv) => !uv || inside(uv))).map(({ id }) => id);
};
