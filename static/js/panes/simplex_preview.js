/** Preview of the simplex, running or replayed: the positions of the matches in the photograph under its current pose. */

import { simplexRun } from "../state/simplex_run.js";

/** Predicted positions of the step that is shown. */
export class SimplexPreview {
  /** @type {Record<string, (number[] | null)[]> | null} by match id; null while nothing is shown */
  predicted = null;

  /** @param {(began: boolean) => void} changed `began`: there was nothing before, or there is nothing now */
  constructor(changed) {
    simplexRun.onChange(() => {
      const before = this.predicted;
      this.predicted = simplexRun.current?.predicted ?? null;
      if (before || this.predicted) changed(!before || !this.predicted);
    });
  }
}
