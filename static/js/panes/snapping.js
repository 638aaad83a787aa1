/**
 * Snapping: a line's ends move onto the edge under the line, a point to a corner. The program computes it on its exact
 * data; only what is already shown as a ghost is used.
 */

import { throttled } from "../ui/throttle.js";

export const LINE_REACH_PX = 6;
export const CORNER_REACH_PX = 4;
const MIN_REACH_OF_PICTURE_PX = 1;
const OUT_OF_DATE_PX = 12;
const INTERVAL_MS = 40;

/** @param {readonly number[]} a @param {readonly number[]} b */
const distance = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1]);

/**
 * @param {number[][]} line two points
 * @param {readonly number[]} at
 * @returns {number[]} the point of the line through the two that is nearest to a position
 */
const nearestOn = ([a, b], at) => {
  const along = [b[0] - a[0], b[1] - a[1]];
  const share = ((at[0] - a[0]) * along[0] + (at[1] - a[1]) * along[1]) / (along[0] ** 2 + along[1] ** 2);
  return [a[0] + share * along[0], a[1] + share * along[1]];
};

/** @typedef {import("../net/requests.js").Commands["snap"]} Snap */

/** The edge or corner that was found last, and what it makes of the ends that are being placed. */
export class Snapping {
  /** @type {{side: "scan" | "photo", asked: number[][], ends: number[][]} | null} `asked`: for which ends */
  #found = null;
  #request;

  /**
   * @param {(question: Snap) => Promise<any>} ask
   * @param {(side: "scan" | "photo") => Pick<Snap, "photo" | "view">} where the photograph and view that the question refers to
   * @param {() => void} changed
   */
  constructor(ask, where, changed) {
    /** @param {{side: "scan" | "photo", ends: number[][], zoom: number}} wanted */
    const request = async ({ side, ends, zoom }) => {
      const { ends: snapped, found } = await ask({ ...where(side), side, ends, px_per_screen: 1 / zoom });
      this.#found = found ? { side, asked: ends, ends: snapped } : null;
      changed();
    };
    this.#request = throttled(request, INTERVAL_MS);
  }

  /**
   * Request what is under a point or a line.
   * @param {import("./pane.js").Pane} pane
   * @param {number[][]} ends one pixel or two
   */
  request(pane, ends) {
    this.#request({ side: pane.side, ends, zoom: pane.viewport.zoom });
  }

  /** Drop the request and its result. */
  forget() {
    this.#request.forget();
    this.#found = null;
  }

  /**
   * @param {import("./pane.js").Pane} pane
   * @param {readonly (readonly number[])[]} ends present position of a point or of both ends of a line, pixels
   * @returns {number[][] | null} their snapped positions, if these are within reach on the screen
   */
  near(pane, ends) {
    const found = this.#found;
    if (found?.side !== pane.side || found.ends.length !== ends.length) return null;
    const { zoom } = pane.viewport;
    /** @param {readonly (readonly number[])[]} a @param {readonly (readonly number[])[]} b @param {number} reach */
    const within = (a, b, reach) => a.every((at, k) => distance(at, b[k]) * zoom <= reach);
    if (ends.length === 1) return within(ends, found.ends, CORNER_REACH_PX) ? found.ends : null;
    if (!within(ends, found.asked, Math.max(OUT_OF_DATE_PX, MIN_REACH_OF_PICTURE_PX * zoom))) return null;
    const snapped = ends.map((at) => nearestOn(found.ends, at));
    return within(ends, snapped, Math.max(LINE_REACH_PX, MIN_REACH_OF_PICTURE_PX * zoom)) ? snapped : null;
  }
}
