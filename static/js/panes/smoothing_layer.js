/** Drawing of ranges that would be replaced over the picture of the scan: rings at spikes, crosses at depth edges. */

import { stamp } from "./symbols.js";
import { toScreen } from "./viewport.js";

/**
 * @typedef {import("./viewport.js").Viewport} Viewport
 * @typedef {import("./colors.js").Look} Look
 */

/**
 * @param {import("../state/smoothing.js").NewRange[]} ranges of the scan that is shown
 * @param {import("./sides.js").ScanSide} side
 * @returns {{id: string, edge: boolean, uv: number[]}[]} in pixels of the picture
 */
export const smoothedMarks = (ranges, side) =>
  ranges.flatMap(({ id, edge, ray }) => {
    const uv = side.toPixel(ray);
    return uv ? [{ id, edge, uv }] : [];
  });

/**
 * @param {CanvasRenderingContext2D} context
 * @param {ReturnType<typeof smoothedMarks>} marks
 * @param {string | null} chosen id of the one that is pointed at
 * @param {boolean} edges whether those at depth edges would be replaced, too
 * @param {Viewport} viewport
 * @param {Look} look
 */
export const drawSmoothed = (context, viewport, marks, chosen, edges, look) => {
  /** @param {(mark: typeof marks[number]) => boolean} wanted */
  const at = (wanted) => marks.filter(wanted).map(({ uv }) => toScreen(viewport, uv));
  const ring = { colour: look.bad, halo: look.halo, radius: 5, width: 1.75 };
  const cross = { colour: edges ? look.warn : look.dim, halo: look.halo, radius: 0, width: 1.75, cross: 4 };
  stamp(context, look, at(({ id, edge }) => !edge && id !== chosen), ring);
  stamp(context, look, at(({ id, edge }) => edge && id !== chosen), cross);
  stamp(context, look, at(({ id, edge }) => !edge && id === chosen), { ...ring, radius: 8, width: 2.5, dot: 1.5 });
  stamp(context, look, at(({ id, edge }) => edge && id === chosen), { ...cross, cross: 7, width: 2.5 });
};
