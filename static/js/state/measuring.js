/** What can be measured, and what has been: the slices `measurements` and `measured` together. */

import { store } from "../net/store.js";

/** @typedef {import("../net/store.js").Slices} Slices */
/**
 * @typedef {{label: string, least: number, most: number | null, points: string[]}} Measure `most`: null if the number of
 *   points is open; `points`: what each of them is, the last word for all further ones
 */

/** @type {Record<Measurement["kind"], Measure>} */
export const MEASURES = {
  distance: { label: "Distance", least: 2, most: 2, points: ["the first point", "the second point"] },
  height: { label: "Height above a plane", least: 4, most: null, points: ["the point", "a point of the plane below it", "another point of the plane"] },
  point: { label: "Point", least: 1, most: 1, points: ["the point"] },
  polyline: { label: "Polyline", least: 2, most: null, points: ["the first point", "the next point"] },
  angle: { label: "Angle", least: 3, most: 3, points: ["a point on the first side", "the vertex", "a point on the other side"] },
  area: { label: "Area", least: 3, most: null, points: ["the first corner", "the next corner, in order"] },
};

/**
 * @typedef {import("../protocol.d.ts").Measured} Measured
 * @typedef {import("../protocol.d.ts").Measurement & Measured & {known: boolean}} Measurement
 */

/** @type {Omit<Measured, "id"> & {known: boolean}} */
const UNKNOWN = { known: false, value: "", interval: "", notes: [], refusal: "", drawn: null, in_photo: {} };
/** @type {{from: [Slices["measurements"] | null, Slices["measured"] | null], list: Measurement[]}} the slices, and what they say */
let made = { from: [null, null], list: [] };

/** @returns {Measurement[]} the same list while nothing has changed */
export const measurementsNow = () => {
  /** @type {typeof made.from} */
  const from = [store.get("measurements"), store.get("measured")];
  if (from.some((slice, k) => slice !== made.from[k])) {
    const [kept, measured] = [from[0] ?? [], from[1] ?? []];
    const values = new Map(measured.map((one) => [one.id, one]));
    const list = kept.map((one) => ({ ...UNKNOWN, ...one, ...values.get(one.id), known: values.has(one.id) }));
    made = { from, list };
  }
  return made.list;
};

/** @param {string | null} id @returns {Measurement | null} */
export const measurementOf = (id) => measurementsNow().find((one) => one.id === id) ?? null;
