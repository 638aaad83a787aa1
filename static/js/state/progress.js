/** Progress of the work, as the server derives it from the document. No DOM here. */

import { store } from "../net/store.js";

/**
 * @typedef {{name: string, title: string, purpose: string, refusal: string}} Target what can be exported, as
 *   `export_targets` answers; `refusal`: why it cannot be written, empty if it can
 */

/** @type {[WorkStep["name"], string][]} */
const LABELS = [["match", "Match"], ["solve", "Solve"], ["judge", "Judge"], ["export", "Export"]];
/** @type {import("../protocol.d.ts").Progress} */
const NOTHING = { steps: [], needed: "", next_action: "", exported: {} };

/**
 * @typedef {{name: "acquire" | "stations" | "match" | "solve" | "judge" | "export", label: string, done: boolean, missing: string,
 *            status: string}} WorkStep `missing` is what has to be done, empty if nothing
 */

/** @returns {import("../protocol.d.ts").Progress} of the shown photograph */
export const progressNow = () => store.get(`progress:${store.shown()}`) ?? store.get("progress") ?? NOTHING;

/** @returns {WorkStep[]} the four steps, of the shown photograph */
export const workSteps = () => {
  /** @type {Map<string, import("../protocol.d.ts").WorkStep>} */
  const known = new Map(progressNow().steps.map((step) => [step.name, step]));
  return LABELS.map(([name, label]) => ({
    done: false, missing: "", status: "", ...known.get(name), name, label,
  }));
};
