/** The thesis's chain, step by step: which job does it, which settings belong to it, how it stands. No DOM here. */

import { counted, duration, fixed } from "../ui/numbers.js";

/**
 * `parts` are what the settings name as `step_of`; `stage` is the pose that the step leaves, `leaves` the origin of its
 * matches.
 * @typedef {{job: string, label: string, said: string, parts: string[], stage?: string, leaves?: string,
 *            in: "match" | "solve"}} ChainStep
 */

/** @type {ChainStep[]} */
export const CHAIN = [
  {
    job: "find_corners",
    label: "Find corners",
    said: "Corners in both pictures (2.3.2)",
    parts: ["corners"],
    in: "match",
  },
  {
    job: "match",
    label: "Match corners",
    said: "Correlation of gray and edges, unique by T1 (2.3.2)",
    parts: ["match"],
    leaves: "corner",
    in: "match",
  },
  {
    job: "cull",
    label: "Cull by disparity",
    said: "Takes away what moves unlike its neighbours (2.3.2, T2)",
    parts: ["cull"],
    in: "match",
  },
  {
    job: "linear",
    label: "Linear",
    said: "A first pose without a start (2.4.1)",
    parts: ["linear"],
    stage: "linear",
    in: "solve",
  },
  {
    job: "constrained",
    label: "Second search",
    said: "Matches again, near where the linear pose predicts them",
    parts: ["constrained"],
    stage: "constrained_linear",
    in: "solve",
  },
  {
    job: "densify",
    label: "Densify lines",
    said: "Lines between matches on planes",
    parts: ["densify", "lines"],
    leaves: "between corners",
    in: "match",
  },
  {
    job: "simplex",
    label: "Simplex",
    said: "Downhill simplex over the six parameters (2.4.2)",
    parts: ["simplex"],
    stage: "simplex",
    in: "solve",
  },
  {
    job: "reject_outliers",
    label: "Reject outliers",
    said: "Leaves out large depth errors and walks again",
    parts: ["reject", "reject_outliers"],
    stage: "simplex_outliers_removed",
    in: "solve",
  },
  {
    job: "robust",
    label: "Robust",
    said: "All matches weighed by their own noise",
    parts: ["robust"],
    stage: "robust",
    in: "solve",
  },
  {
    job: "verify",
    label: "Verify",
    said: "Judges the shown pose on the pictures themselves",
    parts: ["verify"],
    in: "solve",
  },
];

/** Settings that belong to no step, or to all. */
export const OTHERS = { job: "", label: "Of all steps", said: "What holds for every step", parts: [], in: "solve" };

const KNOWN = new Set(CHAIN.flatMap(({ parts }) => parts));

/**
 * @param {Record<string, any> | null} settings slice `settings`
 * @param {ChainStep} step or OTHERS
 * @returns {[string, any][]} names and entries
 */
export const settingsOf = (settings, step) =>
  Object.entries(settings ?? {}).filter(([, entry]) =>
    step.parts.length ? step.parts.includes(entry.step_of) : !KNOWN.has(entry.step_of),
  );

/**
 * How a step stands.
 * @param {ChainStep} step
 * @param {{job: any, last: any, stages: any[], corners: any, picks: any[]}} of `last` is the newest finished job of
 *   this kind
 * @returns {{state: "none" | "running" | "paused" | "done" | "failed" | "stopped", said: string}}
 */
export const stepState = (step, { job, last, stages, corners, picks }) => {
  if (job?.kind === step.job && (job.state === "running" || job.state === "paused")) return {
    state: job.state,
    said: job.said || job.state,
  };
  if (last?.state === "failed") return { state: "failed", said: last.said };
  const stage = step.stage && stages.find((each) => each.stage === step.stage);
  if (stage) return { state: "done", said: stageInShort(stage) };
  if (last?.state === "stopped") return { state: "stopped", said: last.said || "stopped" };
  if (last) return { state: "done", said: last.said };
  if (step.job === "find_corners" && corners) return {
    state: "done",
    said: `${corners.scan?.length ?? 0} and ${corners.photo?.length ?? 0} corners`,
  };
  const found = picks.filter(({ origin }) => origin === step.leaves).length;
  if (found) return { state: "done", said: counted(found, "match", "matches") };
  return { state: "none", said: "" };
};

/** @returns {string} such as `128 of 134, 0.42 px, 1.2 s` */
export const stageInShort = (stage) =>
  [
    stage.matches === undefined ? "" : `${stage.inliers} of ${stage.matches}`,
    Number.isFinite(stage.median_px) ? `${fixed(stage.median_px, 2)} px` : "",
    stage.seconds ? duration(stage.seconds) : "",
  ].filter(Boolean).join(", ");

/** @returns {number | null} share of a job that is done, 0 to 1; null where nobody knows */
export const shareDone = (job) => (job && job.total > 0 ? Math.max(0, Math.min(1, job.done / job.total)) : null);

/** @returns {boolean} whether a job is under way */
export const runs = (job) => job?.state === "running" || job?.state === "paused";
