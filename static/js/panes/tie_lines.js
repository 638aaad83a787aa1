/** Lines that are drawn in several pictures: what is said of them, and what is to be done next. No DOM here. */

import { counted, fixed } from "../ui/numbers.js";

/** Photographs of a line that say something of their poses; with the scan, one is enough. */
export const ENOUGH = 3;

/** @typedef {import("../protocol.d.ts").DrawnLine} DrawnLine */

/** @param {DrawnLine} line @returns {boolean} whether a scan of the project shows it */
export const isInScan = ({ in_scan }) => in_scan !== null && in_scan.station !== null;

/** @param {DrawnLine} line @returns {boolean} whether a line constrains the poses */
const isEnough = (line) => line.photos.length >= (isInScan(line) ? 1 : ENOUGH);

/**
 * @param {DrawnLine} line
 * @returns {string} what the last adjustment said of a line, or what it needs
 */
export const lineSaid = (line) => {
  if (line.agrees !== null) return line.reason;
  if (isEnough(line)) return "not adjusted yet";
  if (isInScan(line)) return "in the scan alone: draw it in a photograph";
  if (line.photos.length === 0) return "its scan is no longer in the project: draw it again, or remove it";
  return line.photos.length === 1
    ? "in one photograph: draw it in two more, or in the scan"
    : "in two photographs, which do not constrain their poses: draw it in a third, or in the scan";
};

/**
 * @param {DrawnLine} line
 * @param {Map<string, string>} names of the photographs, by their ids
 * @returns {string} its pictures, with its residual in each
 */
export const lineShownIn = (line, names) => {
  const shown = line.photos.map((id) => {
    const px = line.residuals_px[id];
    return `${names.get(id) ?? id}${px === undefined ? "" : ` ${fixed(px, 1)} px`}`;
  });
  const { in_scan: there, scan_residual: off } = line;
  if (there) shown.push(`${there.name}${there.station === null ? " (no longer in the project)" : off === null ? ` ± ${there.sigma}` : ` ${off}`}`);
  return shown.join(" – ");
};

/** @param {DrawnLine} line @returns {string} in which pictures it is drawn */
const drawnIn = (line) => {
  const scan = isInScan(line) ? ["the scan"] : [];
  return [...(line.photos.length ? [counted(line.photos.length, "photograph")] : []), ...scan].join(" and ") || "no picture";
};

/**
 * @param {{readOnly: boolean, photos: number, hasScan: boolean, begun: string | null, line: DrawnLine | null, number: string}} now
 *   `photos` of the project; `begun`: in which picture one end is placed, as `third photograph` or `scan`; `line` that is
 *   drawn further
 * @returns {string} what to do next
 */
export const lineHint = ({ readOnly, photos, hasScan, begun, line, number }) => {
  if (readOnly) return "Lines are shown only: this link is read-only.";
  if (photos < (hasScan ? 1 : ENOUGH)) {
    const needs = hasScan ? "a photograph" : `${ENOUGH} photographs`;
    return `A line needs ${needs}, and the project has ${photos || "none"}: add others, or draw places.`;
  }
  if (begun) return `Now click another place of the same edge in the ${begun}, far from the first; Backspace takes that back.`;
  const others = hasScan ? "; or in one photograph and the scan" : "";
  if (!line)
    return `Click two places of a straight edge in one photograph, then in two or more others${others}. They need not be the same places. Wheel: zoom; drag: move.`;
  const drawn = `Line ${number} is drawn in ${drawnIn(line)}`;
  if (isEnough(line)) return `${drawn}: draw it in a further one, or begin another where it is drawn already. Drag an end to move it.`;
  if (isInScan(line)) return `${drawn}: click two places of the same edge in a photograph.`;
  const orScan = hasScan ? ", or in the scan" : "";
  if (line.photos.length < 2) return `${drawn}: click two places of the same edge in two others${orScan}.`;
  return `${drawn}, which do not constrain their poses: draw it in a third${orScan}. If both show the same two ends, keep these as ties instead.`;
};
