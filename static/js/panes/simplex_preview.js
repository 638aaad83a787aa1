/** The simplex while it runs: where each of its steps puts the matches in the photograph. */

const FORGOTTEN_AFTER_MS = 2500;

/** Predictions of the newest step. */
export class Running {
  /** @type {Record<string, (number[] | null)[]> | null} by match; null while nothing runs */
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
      // A paused solver stays where it is; one that says no more has gone.
      this.#timer = setTimeout(() => store.get("job")?.state !== "paused" && end(), FORGOTTEN_AFTER_MS);
      changed(began);
    });
    store.on("job", (job) => (!job || !["running", "paused"].includes(job.state)) && end());
    store.on("shown", end);
  }
}
