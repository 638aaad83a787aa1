/** The scans in which lines are drawn, beside the photographs: which station and view is shown, and what lines are there. */

import { request } from "../net/requests.js";
import { fill } from "../ui/controls.js";
import { element } from "../ui/dom.js";
import { scanOfStation, stationsNow } from "../state/stations.js";
import { axisOf, pixelOf, rayOf, segmentOf } from "./projection.js";
import { scanAddress } from "./sides.js";
import { amid, anglesOf, directionLabel, viewTowards } from "./strip_geometry.js";

const PICKED_PX = 0.5; // standard deviation of a click along each axis, on the screen as in a picture
const MAX_RAD = 0.2;

/** @param {number[]} place @returns {number[]} its direction */
const directionOf = (place) => {
  const length = Math.hypot(...place);
  return place.map((value) => value / length);
};

/**
 * @param {{store: import("../net/store.js").Store, view: any, changed: () => void}} page `changed`: another scan or view is
 *   to be shown
 */
export const makeTieScan = ({ store, view, changed }) => {
  let station = "";
  let index = 0;
  /** @type {Map<string, {of: string, scan: any}>} scans of stations that were asked for, and of which state of these */
  const known = new Map();
  const select = element("select", { class: "select small", "aria-label": "The scan and its view" });
  const state = () => JSON.stringify([store.get("scan")?.id, stationsNow().stations.map(({ id, files }) => [id, files])]);
  const scanOf = (/** @type {string} */ id) => {
    if (id === store.station()) return store.scanBeside();
    if (!id) return store.get("scan");
    const found = known.get(id);
    return found && found.of === state() ? found.scan : null;
  };
  const ask = async (/** @type {string} */ id) => {
    const of = state();
    const found = await request("scan_of", { station: id });
    if (!found) return;
    known.set(id, { of, scan: found.scan });
    changed();
  };
  const choose = (/** @type {string} */ id, /** @type {number} */ number) => {
    [station, index] = [id, number];
    if (!scanOf(id)) void ask(id);
    changed();
  };
  select.addEventListener("change", () => {
    const at = select.value.lastIndexOf("|");
    choose(select.value.slice(0, at), Number(select.value.slice(at + 1)));
  });
  const ids = () => {
    const { stations } = stationsNow();
    return stations.length ? stations.map(({ id }) => id ?? "") : [""];
  };
  /** @returns {[string, string][]} every view of the scans that are known, and each other scan */
  const options = () =>
    ids().flatMap((id) => {
      const name = scanOfStation(id);
      const views = scanOf(id)?.views ?? [];
      if (views.length < 2) return /** @type {[string, string][]} */ ([[`${id}|0`, name]]);
      const listed = views.map((/** @type {any} */ each, /** @type {number} */ k) => [`${id}|${k}`, `${name}, ${each.label || directionLabel(anglesOf(axisOf(each)))}`]);
      return listed.filter((/** @type {string[]} */ _, /** @type {number} */ k) => views[k].label || (id === station && k === index));
    });
  const scan = () => scanOf(station);
  const lens = () => scan()?.views?.[index] ?? null;
  return {
    select,
    /** @returns {boolean} whether there is a scan to draw in */
    get isThere() {
      return Boolean(store.get("scan")?.views?.length);
    },
    get station() {
      return station;
    },
    /** Show what the scan's pane shows, or where the photograph looks that is shown, as far as that is known. */
    follow() {
      [station, index] = [store.station(), view.get().scan.view];
      const views = scan()?.views ?? [];
      const towards = amid(store.get(`outline:${store.shown()}`)?.rays ?? []);
      if (towards && views.length > 1) index = viewTowards(views, towards, index);
    },
    /** Show the scan and, if none of its places is in sight, the view of a line. @param {{station: string | null, xyz: number[][]}} line */
    reveal({ station: wanted, xyz }) {
      if (wanted === null) return;
      if (wanted !== station) choose(wanted, 0);
      const views = scan()?.views ?? [];
      const shows = (/** @type {any} */ each) => each && xyz.some((place) => {
        const uv = pixelOf(each, directionOf(place));
        return uv && uv[0] >= 0 && uv[1] >= 0 && uv[0] < each.width && uv[1] < each.height;
      });
      if (!shows(lens())) index = Math.max(0, views.findIndex((/** @type {any} */ each) => each.label && shows(each)));
    },
    /** @returns {import("./tie_picture.js").Shown | null} the picture */
    shown() {
      if (!ids().includes(station)) this.follow();
      const views = scan()?.views ?? [];
      if (views.length) index = Math.max(0, Math.min(index, views.length - 1));
      fill(select, options(), `${station}|${index}`);
      const of = lens();
      if (!of) return null;
      const address = scanAddress(scan(), index, view.get().scan);
      return { key: address, name: select.selectedOptions[0]?.textContent ?? "", width: of.width, height: of.height, address };
    },
    /**
     * @param {{station: string | null, xyz: number[][]} | null} drawn a line in a scan
     * @returns {{ends: (number[] | null)[], path: number[][]} | null} its pixels in the picture; null: it is not there
     */
    placed(drawn) {
      const of = lens();
      if (!of || !drawn || drawn.station !== station) return null;
      const rays = drawn.xyz.map(directionOf);
      const path = segmentOf(of, rays[0], rays[1]);
      return path && { ends: rays.map((ray) => pixelOf(of, ray)), path };
    },
    /**
     * @param {number[][]} ends pixels of the picture
     * @param {number} zoom at which they were clicked
     * @returns {{scan: number[][], station: string, sigma_rad: number}} as the workbench takes them
     */
    sent(ends, zoom) {
      const of = /** @type {import("./projection.js").ScanView} */ (lens());
      const rays = ends.map((uv) => rayOf(of, uv));
      const beside = rayOf(of, [ends[0][0] + PICKED_PX / zoom, ends[0][1]]);
      const sigma = Math.hypot(...rays[0].map((value, k) => value - beside[k])); // unit rays
      return { scan: rays, station, sigma_rad: Math.min(MAX_RAD, Number(sigma.toPrecision(2))) };
    },
  };
};
