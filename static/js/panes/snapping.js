/** Snapping of ends to the nearest corner. Only a corner that is already shown is used. */

import { throttled } from "../ui/throttle.js";

export const REACH_PX = 6;
const INTERVAL_MS = 40;

/** The corner nearest to the pointer, as last answered. */
export class Snapping {
  #found = null;
  #request;

  /**
   * @param {(what: string, args: any) => Promise<any>} ask
   * @param {() => any} where the photograph and view that the question refers to
   * @param {() => void} changed
   */
  constructor(ask, where, changed) {
    this.#request = throttled(async ({ side, uv }) => {
      const { at, found } = await ask("snap", { ...where(side), side, at: uv });
      this.#found = found ? { side, uv: at } : null;
      changed();
    }, INTERVAL_MS);
  }

  /** Request the corner near a pixel. */
  request(side, uv) {
    this.#request({ side, uv });
  }

  /** Drop the request and its result. */
  forget() {
    this.#request.forget();
    this.#found = null;
  }

  /**
   * @param {import("./pane.js").Pane} pane
   * @param {readonly number[]} uv
   * @returns {number[] | null} the corner, if it is within reach on the screen
   */
  near(pane, uv) {
    if (this.#found?.side !== pane.side) return null;
    const [a, b] = [pane.screenOf(this.#found.uv), pane.screenOf(uv)];
    return Math.hypot(a[0] - b[0], a[1] - b[1]) <= REACH_PX ? this.#found.uv : null;
  }
}
