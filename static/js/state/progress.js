/** Where the work stands: what of the four steps is done, and what the next one still needs. No DOM here. */

import { counted } from "../ui/numbers.js";

/** Points that a pose needs at least, and what a line counts for: its two ends. */
const LEAST_POINTS = 4;
const POINTS_OF_LINE = 2;

/**
 * @typedef {{name: "match" | "solve" | "judge" | "export", label: string, done: boolean, missing: string,
 *            said: string}} WorkStep `missing` is empty where nothing is; `said` tells how it stands
 */

const missingFiles = (scan, photo) => {
  if (!scan && !photo) return "Open a scan and a photograph first.";
  if (!scan) return "Open a scan first.";
  if (!photo) return "Open a photograph first.";
  return photo.camera ? "" : `Tell the focal length of ${photo.name}: nothing in the file says it.`;
};

/**
 * @param {{scan: any, photo: any, picks: any[], poses: any, exported: boolean}} of slices of the shown photograph
 * @returns {WorkStep[]}
 */
export const workSteps = ({ scan, photo, picks, poses, exported }) => {
  const files = missingFiles(scan, photo);
  const on = picks.filter((pick) => pick.on);
  const points = on.reduce((sum, { kind }) => sum + (kind === "line" ? POINTS_OF_LINE : 1), 0);
  const stages = poses?.stages ?? [];
  const shown = stages.find(({ stage }) => stage === poses?.shown) ?? null;
  const matched = points >= LEAST_POINTS;
  const solved = stages.length > 0;
  const fewer = Math.ceil((LEAST_POINTS - points) / POINTS_OF_LINE);
  const more = `${counted(fewer, "more line")}, or ${counted(LEAST_POINTS - points, "more point")}`;
  const allOff = picks.length > 0 && on.length === 0;
  const off = picks.length === 1
    ? "The only match is switched off: switch it on in the table."
    : `All ${picks.length} matches are switched off: switch some on in the table.`;
  const wanted = allOff ? off : `A pose needs ${more}.`;
  const matches = files || (matched ? "" : wanted);
  return [
    {
      name: "match",
      label: "Match",
      done: matched,
      missing: solved ? files : matches,
      said: on.length ? `${counted(on.length, "match", "matches")} on.` : "No matches yet.",
    },
    {
      name: "solve",
      label: "Solve",
      done: solved,
      missing: solved
        ? ""
        : files || (matched ? "Run a solver, or register automatically." : `${matches} Or register automatically.`),
      said: shown ? `${shown.label} is shown.` : "Not solved yet.",
    },
    {
      name: "judge",
      label: "Judge",
      done: Boolean(shown?.accepted),
      missing: shown
        ? (shown.accepted ? "" : "The pose shown is not accepted: read why, and what would help.")
        : "Solve first.",
      said: shown ? shown.verdict : "There is no pose to judge yet.",
    },
    {
      name: "export",
      label: "Export",
      done: exported,
      missing: shown
        ? (shown.accepted ? "" : "Only the figures can be written: nothing is coloured from a pose that is not " +
          "accepted.")
        : "Solve first.",
      said: exported ? "Written." : "Nothing written yet.",
    },
  ];
};

/**
 * The one thing to do next, for somebody who sees this for the first time.
 * @param {{scan: any, photo: any, picks: any[], poses: any}} of
 * @returns {string}
 */
export const nextThing = ({ scan, photo, picks, poses }) => {
  const files = missingFiles(scan, photo);
  if (files) return files;
  if (!poses?.stages?.length && picks.length === 0)
    return "Press Register automatically; or draw a line along an edge in either picture, then the same edge in " +
      "the other.";
  const [match, solve, judge] = workSteps({ scan, photo, picks, poses, exported: false });
  if (!solve.done) return match.missing || "Enough matches: run the robust solver, or register automatically.";
  return judge.missing || "Accepted: look at the model, then export.";
};
