/** Readout for the status bar: pixel and zoom under the pointer, and the range and intensity in the scan. */

import { inNextFrame, throttled } from "../ui/throttle.js";

const INTERVAL_MS = 100;
const SAME_POINT_RAD = 0.02;

/** @typedef {NonNullable<import("../state/view.js").ViewState["readout"]>} Readout */

/**
 * @param {import("./controller.js").Controller} controller
 * @returns {(pane: import("./pane.js").Pane, uv: number[]) => void} shows the readout of a pixel
 */
export const readoutOf = (controller) => {
  /** @type {Pick<Readout, "range_m" | "intensity" | "edge"> & {ray: number[]} | null} what was asked last */
  let known = null;
  /** @type {{pane: import("./pane.js").Pane, uv: number[]} | null} */
  let at = null;

  const show = inNextFrame(() => {
    if (!at) return;
    const { pane, uv } = at;
    /** @type {Readout} */
    const readout = { side: pane.side, uv, zoom: pane.viewport.zoom };
    if (pane.side === "scan" && known) {
      const ray = controller.sides.scan.toWorld(uv);
      const { ray: asked, range_m, intensity, edge } = known;
      const apart = Math.hypot(...ray.map((value, k) => value - asked[k]));
      // until the next answer the last one is shown, unless the pointer has moved far
      if (apart < SAME_POINT_RAD) Object.assign(readout, { range_m, intensity, edge });
    }
    controller.view.set({ readout });
    pane.invalidate("live");
  });

  /** @param {number[]} ray */
  const ask = async (ray) => {
    const { range_m, intensity, edge } = await controller.ask("probe", { scan: ray });
    known = { ray, range_m, intensity, edge };
    if (at && controller.view.get().readout) show();
  };
  const probe = throttled(ask, INTERVAL_MS);

  return (pane, uv) => {
    at = { pane, uv };
    if (pane.side === "scan") probe(controller.sides.scan.toWorld(uv));
    show();
  };
};
