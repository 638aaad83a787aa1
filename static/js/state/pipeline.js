/** The steps of the thesis: their jobs, settings and states; and the state of a job. No DOM here. */

import { counted, duration, fixed, isNumber } from "../ui/numbers.js";

/**
 * @typedef {import("../net/store.js").Slices} Slices
 * @typedef {import("../net/store.js").Job} Job
 * @typedef {import("../net/store.js").Stage} Stage
 * @typedef {import("../protocol.d.ts").Setting} Setting
 */
/**
 * `parts` are the values of `step_of` in the settings; `stage` is the pose that the step produces, `origin` the origin
 * of its matches; a `main` step is always offered, the others among all steps.
 * @typedef {{job: string, label: string, description: string, parts: string[], stage?: string, origin?: string,
 *   main?: boolean}} PipelineStep
 */

/** @type {PipelineStep[]} */
export const PIPELINE = [
  {
    job: "find_corners",
    label: "Find corners",
    description: "Detects corners in both pictures (2.3.2)",
    parts: ["corners"],
  },
  {
    job: "match",
    label: "Match corners",
    description: "Matches corners by correlation, with uniqueness threshold T1 (2.3.2); where too few of them agree, near what a " +
      "rough pose predicts",
    parts: ["match"],
    origin: "corner",
    main: true,
  },
  {
    job: "cull",
    label: "Filter by disparity",
    description: "Removes matches whose disparity differs from their neighbours' (2.3.2, T2)",
    parts: ["cull"],
  },
  {
    job: "linear",
    label: "Linear",
    description: "Computes a first pose without a starting pose (2.4.1)",
    parts: ["linear"],
    stage: "linear",
  },
  {
    job: "constrained",
    label: "Guided matching",
    description: "Matches again near the positions that the linear pose predicts",
    parts: ["constrained"],
    stage: "constrained_linear",
  },
  {
    job: "densify",
    label: "Lines between matches",
    description: "Adds lines between matches on planes",
    parts: ["densify", "lines"],
    origin: "between corners",
  },
  {
    job: "simplex",
    label: "Simplex",
    description: "Downhill simplex over the six parameters (2.4.2)",
    parts: ["simplex"],
    stage: "simplex",
    main: true,
  },
  {
    job: "reject_outliers",
    label: "Remove outliers",
    description: "Removes outliers and solves again",
    parts: ["reject", "reject_outliers"],
    stage: "simplex_outliers_removed",
    main: true,
  },
  {
    job: "robust",
    label: "Robust",
    description: "Robust estimate, each match weighted by its own noise",
    parts: ["robust"],
    stage: "robust",
  },
  {
    job: "verify",
    label: "Verify",
    description: "Verifies the shown pose against the image",
    parts: ["verify"],
    main: true,
  },
];

/** @type {PipelineStep} the settings that belong to no single step */
export const GENERAL = { job: "", label: "General", description: "Settings of all steps", parts: [] };

const KNOWN = new Set(PIPELINE.flatMap(({ parts }) => parts));

/**
 * @param {Slices["settings"] | null} settings slice `settings`
 * @param {PipelineStep} step or GENERAL
 * @returns {[string, Setting][]} names and entries
 */
export const settingsOf = (settings, step) =>
  Object.entries(settings ?? {}).filter(([, entry]) =>
    step.parts.length ? step.parts.includes(entry.step_of) : !KNOWN.has(entry.step_of),
  );

/**
 * State of a step.
 * @param {PipelineStep} step
 * @param {{job: Job | null, last: Job | null | undefined, stages: Stage[], shown: Stage | null, corners: Slices["corners:"],
 *   picks: import("../net/store.js").Pick[]}} context `last` is the newest
 *   finished job of this kind, `shown` the shown stage
 * @returns {{state: "none" | "running" | "paused" | "done" | "solved" | "failed" | "stopped" | "stale" | "unclear",
 *   text: string}}
 */
export const stepState = (step, { job, last, stages, shown, corners, picks }) => {
  if (job?.kind === step.job && (job.state === "running" || job.state === "paused")) return {
    state: job.state,
    text: job.said || job.state,
  };
  if (step.job === "verify") return verifyState(shown);
  if (last?.state === "failed") return { state: "failed", text: last.said };
  const stage = step.stage ? stages.find((each) => each.stage === step.stage) : null;
  if (stage?.stale) return { state: "stale", text: `Out of date: ${stage.stale}` };
  if (stage) return { state: stage.accepted ? "done" : "solved", text: stageSummary(stage) };
  if (last?.state === "stopped") return { state: "stopped", text: last.said || "stopped" };
  if (last) return { state: "done", text: last.said };
  if (step.job === "find_corners" && corners) return {
    state: "done",
    text: `${corners.scan.length} and ${corners.photo.length} corners`,
  };
  const found = picks.filter(({ origin }) => origin === step.origin).length;
  if (found) return { state: "done", text: counted(found, "match", "matches") };
  return { state: "none", text: "" };
};

/** @type {Record<string, "done" | "failed" | "unclear">} */
const OF_OUTCOME = { verified: "done", contradicted: "failed", undecidable: "unclear" };

/**
 * The state of the step Verify: what is stored with the shown pose, so that it changes with it.
 * @param {Stage | null} shown
 * @returns {{state: "done" | "none" | "stale" | "failed" | "unclear", text: string}}
 */
const verifyState = (shown) => {
  if (shown?.evidence === "image" && !shown.image) return { state: "done", text: shown.reasons?.[0] ?? "" };
  if (!shown?.image) return { state: "none", text: "" };
  if (shown.stale) return { state: "stale", text: `Out of date: ${shown.stale}` };
  return { state: OF_OUTCOME[shown.image.outcome] ?? "none", text: shown.image.sentence };
};

/**
 * @param {Stage} stage
 * @returns {string} matches that agree, median residual and time, such as `128 of 134 agree, median 0.42 px, 1.2 s`
 */
export const stageSummary = (stage) =>
  [
    stage.matches === undefined ? "" : `${stage.inliers} of ${stage.matches} agree`,
    isNumber(stage.median_px) ? `median ${fixed(stage.median_px, 2)} px` : "",
    stage.seconds ? duration(stage.seconds) : "",
  ].filter(Boolean).join(", ");

/** @param {Job | null} job slice `job` @returns {number | null} share of a job that is done, 0 to 1; null if unknown */
export const shareDone = (job) => (job && job.total > 0 ? Math.max(0, Math.min(1, job.done / job.total)) : null);

/** @param {Job | null} job slice `job` @returns {boolean} whether a job is running or paused */
export const isRunning = (job) => job?.state === "running" || job?.state === "paused";

/** @param {Job | null} job slice `job` @returns {Job | null} the job, while it is running or paused */
export const runningJob = (job) => (isRunning(job) ? job : null);

/**
 * The job that keeps a photograph busy: one that runs on it or on the whole project, or one that waits for it. Jobs on other
 * photographs do not matter: the next one begins after them.
 * @param {Job | null} job the slice
 * @param {string | null | undefined} photo
 * @returns {Job | import("../protocol.d.ts").WaitingJob | null} null if the photograph is free
 */
export const jobOn = (job, photo) => {
  if (!job || !isRunning(job)) return null;
  return [job, ...job.waiting].find((each) => !each.photo || each.photo === photo) ?? null;
};
