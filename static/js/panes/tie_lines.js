/** Lines that are drawn in several photographs: what is said of them, and what is to be done next. No DOM here. */

import { counted, fixed } from "../ui/numbers.js";

/** Photographs of a line that say something of their poses. */
export const ENOUGH = 3;

/** @typedef {import("../protocol.d.ts").DrawnLine} DrawnLine */

/** @param {DrawnLine} line @returns {boolean} whether a line does not constrain the poses yet */
const needsMore = ({ photos, in_scan }) => !in_scan && photos.length < ENOUGH;

/**
 * @param {DrawnLine} line
 * @returns {string} what the last adjustment said of a line, or what it needs
 */
export const lineSaid = (line) => {
  if (line.agrees !== null) return line.reason;
  if (!needsMore(line)) return "not adjusted yet";
  return line.photos.length === 1 ? "in one photograph: draw it in two more" : "in two photographs, which do not constrain their poses: draw it in a third";
};

/**
 * @param {DrawnLine} line
 * @param {Map<string, string>} names of the photographs, by their ids
 * @returns {string} its photographs, with its residual in each
 */
export const lineShownIn = (line, names) =>
  line.photos
    .map((id) => {
      const px = line.residuals_px[id];
      return `${names.get(id) ?? id}${px === undefined ? "" : ` ${fixed(px, 1)} px`}`;
    })
    .join(" – ") + (line.in_scan ? " – the scan" : "");

/**
 * @param {{readOnly: boolean, photos: number, begun: string | null, line: DrawnLine | null, number: string}} now
 *   `photos` of the project; `begun`: in which picture one end is placed; `line` that is drawn further
 * @returns {string} what to do next
 */
export const lineHint = ({ readOnly, photos, begun, line, number }) => {
  if (readOnly) return "Lines are shown only: this link is read-only.";
  if (photos < ENOUGH) return `A line needs ${ENOUGH} photographs, and the project has ${photos}: add others, or draw places.`;
  if (begun) return `Now click another place of the same edge in the ${begun} photograph, far from the first; Backspace takes that back.`;
  if (!line)
    return "Click two places of a straight edge in one photograph, then in two or more others; they need not be the same places. Wheel: zoom; drag: move.";
  const drawn = `Line ${number} is drawn in ${counted(line.photos.length, "photograph")}`;
  if (line.in_scan || line.photos.length >= ENOUGH) return `${drawn}: draw it in a further one, or begin another where it is drawn already.`;
  if (line.photos.length === 1) return `${drawn}: click two places of the same edge in two others.`;
  return `${drawn}, which do not constrain their poses: draw it in a third. If both show the same two ends, keep these as ties instead.`;
};
