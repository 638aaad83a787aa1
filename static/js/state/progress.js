/** Progress of the work: which of the four steps are done, and what the next one needs. No DOM here. */

import { counted } from "../ui/numbers.js";

/** The minimum number of points of a pose; a line counts as its two ends. */
const LEAST_POINTS = 4;
const POINTS_OF_LINE = 2;

/**
 * @typedef {{name: "match" | "solve" | "judge" | "export", label: string, done: boolean, missing: string,
 *            status: string}} WorkStep `missing` is what has to be done, empty if nothing
 */

const missingFiles = (scan, photo) => {
  if (!scan && !photo) return "Open a scan and a photograph first.";
  if (!scan) return "Open a scan first.";
  if (!photo) return "Open a photograph first.";
  return photo.camera ? "" : `Enter the focal length of ${photo.name}: the file does not contain it.`;
};

/**
 * @param {any[]} picks
 * @returns {string} what a pose needs besides the enabled matches, a sentence; empty if nothing
 */
export const missingMatches = (picks) => {
  const enabled = picks.filter((pick) => pick.on);
  const points = enabled.reduce((sum, { kind }) => sum + (kind === "line" ? POINTS_OF_LINE : 1), 0);
  if (points >= LEAST_POINTS) return "";
  if (picks.length > 0 && enabled.length === 0) return picks.length === 1
    ? "The only match is disabled: enable it in the table."
    : `All ${picks.length} matches are disabled: enable some in the table.`;
  const lines = Math.ceil((LEAST_POINTS - points) / POINTS_OF_LINE);
  return `A pose needs ${counted(lines, "more line")}, or ${counted(LEAST_POINTS - points, "more point")}.`;
};

/**
 * @param {{scan: any, photo: any, picks: any[], poses: any, exported: boolean}} slices of the shown photograph;
 *   `exported`: the shown pose has been exported
 * @returns {WorkStep[]}
 */
export const workSteps = ({ scan, photo, picks, poses, exported }) => {
  const files = missingFiles(scan, photo);
  const enabled = picks.filter((pick) => pick.on);
  const stages = poses?.stages ?? [];
  const shown = stages.find(({ stage }) => stage === poses?.shown) ?? null;
  const needed = missingMatches(picks);
  const matched = !needed;
  const solved = stages.length > 0;
  const stale = shown?.stale ? `${shown.stale}.` : "";
  const matches = files || needed;
  return [
    {
      name: "match",
      label: "Match",
      done: matched,
      missing: solved ? files : matches,
      status: enabled.length ? `${counted(enabled.length, "match", "matches")} enabled.` : "No matches yet.",
    },
    {
      name: "solve",
      label: "Solve",
      done: Boolean(shown?.accepted) && !stale,
      missing: solved
        ? stale
        : files || (matched ? "Solve from the matches, or register automatically." : `${matches} Or register automatically.`),
      status: shown ? `Shown: ${shown.label}.` : "Not solved yet.",
    },
    {
      name: "judge",
      label: "Judge",
      done: Boolean(shown?.accepted) && !stale,
      missing: stale || (shown
        ? (shown.accepted ? "" : "The shown pose is not accepted: see the reasons and suggestions.")
        : "Solve first."),
      status: shown ? (stale ? "The verdict is out of date." : shown.verdict) : "No pose yet.",
    },
    {
      name: "export",
      label: "Export",
      done: exported && !stale,
      missing: stale || (shown
        ? (shown.accepted ? "" : "Only registration data can be exported: no coloured output is written from a pose that is not " +
          "accepted.")
        : "Solve first."),
      status: exported ? "Exported." : "Not exported yet.",
    },
  ];
};

/**
 * The next action, for a new user.
 * @param {{scan: any, photo: any, picks: any[], poses: any}} slices of the shown photograph
 * @returns {string}
 */
export const nextAction = ({ scan, photo, picks, poses }) => {
  const files = missingFiles(scan, photo);
  if (files) return files;
  if (!poses?.stages?.length && picks.length === 0)
    return "Click Register automatically; or draw a line along an edge in one picture, then along the same edge in " +
      "the other.";
  const [match, solve, judge] = workSteps({ scan, photo, picks, poses, exported: false });
  if (!solve.done && picks.length === 0)
    return "Not accepted: draw a line along an edge in one picture, then along the same edge in the other; three or four " +
      "such matches, far apart, help most.";
  if (!solve.done) return match.missing || "There are enough matches: solve from them, or register automatically.";
  return judge.missing || "Accepted: check the model, then export.";
};
