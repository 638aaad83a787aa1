/** Ends that go to the nearest corner. What is taken is only what was shown: a corner that has not come yet is none. */

import { throttled } from "../ui/throttle.js";

export const REACH_PX = 6;
const EVERY_MS = 40;

/** The corner nearest to the pointer, as last told. */
export class Snapping {
  #found = null;
  #asking;

  /**
   * @param {(what: string, args: any) => Promise<any>} ask
   * @param {() => any} where which photograph and view the question is about
   * @param {() => void} changed
   */
  constructor(ask, where, changed) {
    this.#asking = throttled(async ({ side, uv }) => {
      const { at, found } = await ask("snap", { ...where(side), side, at: uv });
      this.#found = found ? { side, uv: at } : null;
      changed();
    }, EVERY_MS);
  }

  /** Look for a corner near a pixel. */
  look(side, uv) {
    this.#asking({ side, uv });
  }

  /** Look no longer, and forget what was found. */
  forget() {
    this.#asking.forget();
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
