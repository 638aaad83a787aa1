/** The survey as this page sees it: its photographs in an order, and what is said of all. No DOM here. */

import { counted, fixed } from "../ui/numbers.js";

/** @type {[string, string][]} orders of the list */
export const ORDERS = [["list", "In order"], ["worst", "Worst first"]];
/** @type {[string, string][]} which photographs are listed */
export const SHOWN = [["all", "All"], ["open", "Not accepted"], ["accepted", "Accepted"]];

/** @typedef {{id: string, name: string, rev?: string, error?: string, accepted: boolean, light: string | undefined, state: string, position: string,
 *   sigma_m: number | null, ties: number | null, left_out: number, median_px: number | null, part: string, moved: string,
 *   reason: string}} SurveyRow */

/**
 * @typedef {import("../net/store.js").Photo} Photo
 * @typedef {import("../protocol.d.ts").Survey} Survey
 */

/** @param {Photo} photo entry of slice `photos` @param {boolean} refused by the adjustment @returns {string} */
const stateOf = (photo, refused) => {
  if (photo.error) return "cannot be read";
  if (!photo.camera) return "focal length unknown";
  if (photo.part === "out") return "taken out";
  const state = photo.light_words ?? (refused ? "not accepted" : "waiting");
  return photo.part === "held" ? `${state}, held` : state;
};

/**
 * @param {Photo} photo entry of slice `photos`
 * @param {Survey["photos"][number] | undefined} found the photograph in the slice `survey`, if it is there
 * @returns {SurveyRow}
 */
const rowOf = (photo, found) => {
  const current = found && !found.changed ? found : null;
  const refused = current !== null && !current.accepted && !photo.light;
  return {
    id: photo.id,
    name: photo.name,
    rev: photo.rev,
    error: photo.error,
    accepted: photo.state === "accepted",
    light: photo.error || refused ? "not_accepted" : photo.part === "out" ? undefined : photo.light,
    state: stateOf(photo, refused),
    position: photo.position ? `± ${photo.position}` : "",
    sigma_m: current ? current.sigma_m : null,
    ties: current ? current.ties : null,
    left_out: current ? current.ties_left_out : 0,
    median_px: current ? current.median_px : null,
    part: photo.part ?? "free",
    moved: current?.accepted && current.moved ? `moved by ${current.moved} when everything was adjusted` : "",
    reason: photo.error ?? (current ? current.reasons[0] ?? "" : ""),
  };
};

/** What stands for how bad a photograph is: those that are not accepted first, then by residual and uncertainty. @param {SurveyRow} row */
const badness = (row) => [row.accepted ? 0 : 1, row.median_px ?? 0, row.sigma_m ?? 0];

/** @param {SurveyRow} a @param {SurveyRow} b @returns {number} */
const byBadness = (a, b) => {
  const [first, second] = [badness(a), badness(b)];
  const at = first.findIndex((value, k) => value !== second[k]);
  return at < 0 ? 0 : second[at] - first[at];
};

/**
 * @param {Photo[]} photos slice `photos`
 * @param {Survey | null} survey slice `survey`, null before everything was adjusted
 * @param {{order: string, filter: string}} chosen
 * @returns {SurveyRow[]}
 */
export const rowsOf = (photos, survey, { order, filter }) => {
  const found = new Map((survey?.photos ?? []).map((each) => [each.id, each]));
  const rows = photos
    .map((photo) => rowOf(photo, found.get(photo.id)))
    .filter((row) => filter === "all" || row.accepted === (filter === "accepted"));
  return order === "worst" ? rows.sort(byBadness) : rows;
};

/** By how much the residuals of ties are enlarged in the photograph. */
export const TIE_FACTOR = 20;

/**
 * @param {number[][] | null | undefined} ties slice `ties:pID`
 * @param {{ties: number, ties_left_out: number} | undefined} found the photograph in the slice `survey`
 * @returns {string} what is drawn of the ties in the photograph; empty: nothing
 */
export const tiesSaid = (ties, found) => {
  if (!ties?.length || !found) return "";
  const total = found.ties + found.ties_left_out;
  const drawn = ties.length < total ? `${ties.length} of ${total} ties` : counted(total, "tie");
  return `In the photograph: ${drawn}, needles ${TIE_FACTOR} × their residuals${found.ties_left_out ? ", crosses where left out" : ""}.`;
};

/** @param {Survey | null} survey slice `survey`, or null @returns {string} what the last adjustment says of all */
export const summaryOf = (survey) => {
  if (!survey)
    return "Adjust solves all photographs, their cameras and all scans together: photographs hold each other, and what contradicts the rest is taken out.";
  if (survey.since) return survey.since;
  const said = [`${survey.accepted} of ${survey.photos.length} photographs accepted`];
  if (survey.sigma_px !== null) said.push(`ties to ${fixed(survey.sigma_px, 2)} px`);
  if (survey.chi2_per_dof !== null) said.push(`χ² per degree of freedom ${fixed(survey.chi2_per_dof, 2)}`);
  return `Adjusted together: ${said.join(", ")}.`;
};
