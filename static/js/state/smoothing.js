/** The preview of smoothed ranges, as this page shows it: the slice `smoothing`, and which of its ranges are meant. */

import { store } from "../net/store.js";
import { view } from "./view.js";

/**
 * @typedef {import("../protocol.d.ts").PreviewedRange} NewRange
 * @typedef {import("../protocol.d.ts").SmoothingPreview} Preview
 */

/** @type {NewRange[]} always the same, so that nothing seems to have changed */
const NOTHING = [];

/** @returns {Preview | null} */
export const previewNow = () => store.get("smoothing")?.preview ?? null;

/** @returns {NewRange[]} all ranges of the preview */
export const newRanges = () => previewNow()?.ranges ?? NOTHING;

/** @returns {NewRange[]} those of them that are of the scan that is shown */
export const newRangesHere = () => (previewNow()?.station === store.station() ? newRanges() : NOTHING);

/** @param {{edge: boolean}} range @returns {boolean} whether a range would be replaced: at a spike, or at an edge if the operator says so */
export const isMeant = ({ edge }) => !edge || view.get().smooth_edges;
