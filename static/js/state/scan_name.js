/** What a scan is called that may consist of several clouds. No DOM here. */

const MAX_NAMED = 2;

/** @typedef {{name?: string, files?: string[]} | null | undefined} Scan a scan, or a station's, as its slice describes it */

/** @param {Scan} scan @returns {string} such as "and 3 more", empty for a scan of one file */
export const othersText = (scan) => (scan?.files && scan.files.length > 1 ? `and ${scan.files.length - 1} more` : "");

/** @param {Scan} scan @returns {string} such as "sweep1.pcd and 3 more" */
export const scanName = (scan) => [scan?.name, othersText(scan)].filter(Boolean).join(" ");

/** @param {Scan} scan @returns {string} all its clouds, for a tooltip; the name alone for a scan of one file */
export const cloudNames = (scan) =>
  scan?.files && scan.files.length > 1 ? `${scan.files.length} clouds of one standpoint: ${scan.files.join(", ")}` : scan?.name ?? "";

/** @param {string[]} names @returns {string} such as "a.pcd, b.pcd and 3 more" */
export const listed = (names) => {
  const shown = names.slice(0, MAX_NAMED);
  const rest = names.length - shown.length;
  if (rest) shown.push(rest === 1 ? names[names.length - 1] : `${rest} more`);
  return shown.length > 1 ? `${shown.slice(0, -1).join(", ")} and ${shown.at(-1)}` : shown[0];
};
