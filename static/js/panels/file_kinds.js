/** The type of a file, guessed from its name; the user may choose another. No DOM here. */

/** @typedef {"scan" | "photo" | "camera" | "matches"} Kind */

/** In the order of opening: a camera and matches belong to a photograph. */
export const KINDS = [
  { kind: "scan", label: "Scan" },
  { kind: "photo", label: "Photograph" },
  { kind: "camera", label: "Camera of the shown photograph" },
  { kind: "matches", label: "Matches of the shown photograph" },
];
const ORDER = KINDS.map(({ kind }) => kind);
const SCANS = new Set(["e57", "npz", "pcd"]);
/** Scan formats that may not be readable: the workbench explains what to do with them. */
const OTHER_SCANS = new Set(["fls", "las", "laz", "ply", "pts", "ptx", "zfs"]);
const PHOTOS = new Set(["png", "jpg", "jpeg", "tif", "tiff", "webp", "bmp"]);
const CAMERAS = new Set(["yaml", "yml", "xml"]);

/** File types in the file chooser. */
export const ACCEPTED = [...SCANS, ...PHOTOS, ...CAMERAS, "json", "csv"].map((suffix) => `.${suffix}`).join(",");

/**
 * @param {string} name
 * @returns {{kind: Kind, sure: boolean}} `sure` is false if the name is ambiguous
 */
export const kindOf = (name) => {
  const lower = name.toLowerCase();
  const suffix = lower.slice(lower.lastIndexOf(".") + 1);
  if (SCANS.has(suffix) || OTHER_SCANS.has(suffix)) return { kind: "scan", sure: true };
  if (PHOTOS.has(suffix)) return { kind: "photo", sure: true };
  if (CAMERAS.has(suffix)) return { kind: "camera", sure: true };
  if (suffix === "csv") return { kind: "matches", sure: true };
  if (/cam|calib|intrinsic/.test(lower)) return { kind: "camera", sure: suffix === "json" };
  if (/match|line|pick|point/.test(lower)) return { kind: "matches", sure: suffix === "json" };
  return { kind: suffix === "json" ? "scan" : "photo", sure: false };
};

/**
 * @template {{kind: Kind}} T
 * @param {T[]} files
 * @returns {T[]} in the order of opening
 */
export const inOrder = (files) => [...files].sort((a, b) => ORDER.indexOf(a.kind) - ORDER.indexOf(b.kind));
