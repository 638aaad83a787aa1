/** The traffic light of a verdict: its mark and its colour, the same everywhere. */

/** @type {Record<string, {sign: string, level: string}>} names of `icon`, and CSS classes */
const LIGHTS = {
  verified: { sign: "tick", level: "ok" },
  matches_only: { sign: "ring", level: "only" },
  given: { sign: "info", level: "none" },
  not_accepted: { sign: "warn", level: "warn" },
  out_of_date: { sign: "history", level: "none" },
};

/** @param {string | undefined} light of a summary. @returns {{sign: string, level: string}} */
export const lightOf = (light) => LIGHTS[light ?? ""] ?? { sign: "dot", level: "none" };
