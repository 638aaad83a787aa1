/** Marks: the matches in image pixels of one pane. They are computed once a change, not once a frame. */

import { pixelOf, segmentOf } from "./projection.js";

/**
 * @typedef {import("../net/store.js").Pick} Pick
 * @typedef {import("./projection.js").ScanView} ScanView
 * @typedef {import("../protocol.d.ts").Judged} Judged
 */

/**
 * @typedef {"enabled" | "disabled" | "outlier"} MarkState
 * @typedef {object} Mark
 * @property {string} id
 * @property {number} number
 * @property {"line" | "point"} kind
 * @property {MarkState} state
 * @property {(number[] | null)[]} ends pixels; null if not in front of this view
 * @property {number[][] | null} line the two pixels between which the line is drawn
 * @property {{uv: number[], has_range: boolean}[]} samples of a line, in the scan's pane
 * @property {(number[] | null)[]} predicted its ends under the shown pose, in the photograph's pane
 */

/** @param {Pick} pick @param {Judged | null} judged */
const stateOf = (pick, judged) => {
  if (!pick.on) return "disabled";
  return judged?.by_pick?.[pick.id]?.inlier === false ? "outlier" : "enabled";
};

/**
 * @param {number[][]} ends rays or pixels
 * @param {import("./projection.js").ScanView | null} lens the view of the scan; null for pixels of the photograph
 * @returns {{ends: (number[] | null)[], line: number[][] | null}} in pixels
 */
export const placed = (ends, lens) => ({
  ends: lens ? ends.map((ray) => pixelOf(lens, ray)) : ends,
  line: ends.length < 2 ? null : lens ? segmentOf(lens, ends[0], ends[1]) : [ends[0], ends[1]],
});

/** @param {Judged["lines"][string] | undefined} line @param {ScanView} lens */
const samplesOf = (line, lens) =>
  (line?.scan_samples ?? [])
    .flatMap(([ray, has_range]) => {
      const uv = pixelOf(lens, ray);
      return uv ? [{ uv, has_range }] : [];
    });

/**
 * @param {"scan" | "photo"} side
 * @param {import("../net/store.js").Pick[]} picks
 * @param {Judged | null} judged slice `judged:pID`
 * @param {import("./projection.js").ScanView | null} lens the view of the scan in its pane; null in the photograph's
 *   pane
 * @param {(pick: Pick) => number[][]} endsOf the ends to show, unfinished moves included
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
