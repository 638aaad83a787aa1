/** Preview of a running simplex: the positions of the matches in the photograph under its current pose. */

const EXPIRES_AFTER_MS = 2500;

/** Predicted positions of the newest step. */
export class SimplexPreview {
  /** @type {Record<string, (number[] | null)[]> | null} by match id; null while nothing runs */
  predicted = null;
  #timer = 0;

  /** @param {import("../net/store.js").Store} store @param {(began: boolean) => void} changed */
  constructor(store, changed) {
    const end = () => {
      clearTimeout(this.#timer);
      if (!this.predicted) return;
      this.predicted = null;
      changed(true);
    };
    store.onEvent("simplex", (step) => {
      if (step.photo !== store.shown()) return;
      const began = !this.predicted;
      this.predicted = step.predicted ?? {};
      clearTimeout(this.#timer);
      // a paused solver stays; one without further steps has ended
      this.#timer = setTimeout(() => store.get("job")?.state !== "paused" && end(), EXPIRES_AFTER_MS);
      changed(began);
    });
    store.on("job", (job) => (!job || !["running", "paused"].includes(job.state)) && end());
    store.on("shown", end);
  }
}
