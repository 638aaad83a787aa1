/** What is to be drawn of each match in one pane, in pixels of its picture: worked out once a change, not once a frame. */

import { pixelOf, segmentOf } from "./projection.js";

/**
 * @typedef {"on" | "off" | "rejected"} MarkState
 * @typedef {object} Mark
 * @property {string} id
 * @property {number} number
 * @property {"line" | "point"} kind
 * @property {MarkState} state
 * @property {(number[] | null)[]} ends pixels; null where not in front of this view
 * @property {number[][] | null} line the two pixels between which it is drawn
 * @property {{uv: number[], has_range: boolean}[]} samples of a line, in the scan's pane
 * @property {(number[] | null)[]} predicted where the pose puts its ends, in the photograph's pane
 */

const stateOf = (pick, judged) => {
  if (!pick.on) return "off";
  return judged?.by_pick?.[pick.id]?.inlier === false ? "rejected" : "on";
};

/**
 * @param {number[][]} ends rays or pixels
 * @param {import("./projection.js").ScanView | null} lens the scan's view; null for pixels of the photograph
 * @returns {{ends: (number[] | null)[], line: number[][] | null}} in pixels
 */
export const placed = (ends, lens) => ({
  ends: lens ? ends.map((ray) => pixelOf(lens, ray)) : ends,
  line: ends.length < 2 ? null : lens ? segmentOf(lens, ends[0], ends[1]) : [ends[0], ends[1]],
});

const samplesOf = (told, lens) =>
  (told?.scan_samples ?? [])
    .map(([ray, has_range]) => ({ uv: pixelOf(lens, ray), has_range: Boolean(has_range) }))
    .filter(({ uv }) => uv !== null);

/**
 * @param {"scan" | "photo"} side
 * @param {import("../net/store.js").Pick[]} picks
 * @param {any} judged slice `judged:pID`, or null
 * @param {import("./projection.js").ScanView | null} lens the scan's view in the scan's pane, null in the photograph's
 * @param {(pick: any) => number[][]} endsOf the ends as they are shown: an edit under way comes first
 * @returns {Mark[]}
 */
export const marksOf = (side, picks, judged, lens, endsOf) =>
  picks.map((pick) => ({
    id: pick.id,
    number: pick.number,
    kind: pick.kind,
    state: stateOf(pick, judged),
    ...placed(endsOf(pick), lens),
    samples: lens ? samplesOf(judged?.lines?.[pick.id], lens) : [],
    predicted: side === "photo" ? (judged?.predicted?.[pick.id] ?? []) : [],
  }));
