/** The stations as this page sees them. No DOM here. */

import { store } from "../net/store.js";
import { fixed } from "../ui/numbers.js";
import { scanName } from "./scan_name.js";

/** @typedef {import("../protocol.d.ts").Station} Station */

/** @type {import("../protocol.d.ts").Stations} */
const NONE = {
  stations: [], pairs: [], loops: [], reasons: [], checks: [], stale: false, registered: false,
  done: false, status: "Scans of the same place from elsewhere.", missing: "",
};

/** @returns {import("../protocol.d.ts").Stations} */
export const stationsNow = () => store.get("stations") ?? NONE;

/** @returns {boolean} whether the stations are registered as they are now */
export const isRegistered = () => stationsNow().registered && !stationsNow().stale;

/** @param {import("./scan_name.js").Scan & {index: number}} station @returns {string} its name; of a file with several scans with the scan's number */
export const stationName = (station) =>
  station.index ? `${scanName(station)}, scan ${station.index + 1}` : scanName(station);

/** @param {string} id @returns {string} the name of the scan of a station by its id; empty: the project's */
export const scanOfStation = (id) => {
  const found = stationsNow().stations.find((station) => (station.id ?? "") === id);
  return found ? stationName(found) : scanName(store.get("scan"));
};

/** Rounded up: a bound of the standard deviation, and never 0. @param {number} value @param {number} digits */
const bound = (value, digits) => Math.max(Math.ceil(value * 10 ** digits) / 10 ** digits, 10 ** -digits).toFixed(digits);

/** @param {{sigma_mm: number | null, sigma_deg: number | null}} place @returns {string} how well it is known */
export const sigmaText = ({ sigma_mm, sigma_deg }) =>
  sigma_mm === null || sigma_deg === null ? "" : `σ ≤ ${bound(sigma_mm, 1)} mm, ${bound(sigma_deg, 3)}°`;

/** @param {Station} station @returns {string} what is known of it */
export const stateText = (station) => {
  if (station.id === null) return "shown";
  if (station.state === "fixed") return "fixed";
  if (station.state === "kept") return "as its file states";
  if (station.state === "stated") return "as its file states, not verified";
  if (station.state === "registered") return sigmaText(station) || "registered";
  if (station.rough) return "rough place";
  return station.state === "out" ? "not registered" : "waiting";
};

/** @param {Station} station @returns {string} where it stands, from the one that is shown */
export const placeText = ({ place }) => {
  if (!place) return "";
  const [x, y, z] = [place.x, place.y, place.z].map((value) => fixed(value, 3));
  return `${x}, ${y}, ${z} m, ${fixed(place.yaw_deg, 2)}°`;
};

/** @returns {import("./progress.js").WorkStep} the tab's state */
export const stationsStep = () => {
  const { stations, done, status, missing } = stationsNow();
  return {
    name: "stations",
    label: "Survey",
    done: stations.length > 0 && done,
    missing,
    status,
  };
};
