/** Readout for the status bar: pixel and zoom under the pointer, and the range and intensity in the scan. */

import { inNextFrame, throttled } from "../ui/throttle.js";

const INTERVAL_MS = 100;
const SAME_POINT_RAD = 0.02;

/**
 * @param {import("./controller.js").Controller} controller
 * @returns {(pane: import("./pane.js").Pane, uv: number[]) => void} shows the readout of a pixel
 */
export const readoutOf = (controller) => {
  let known = null;
  let at = null;

  const show = inNextFrame(() => {
    if (!at) return;
    const { pane, uv } = at;
    const readout = { side: pane.side, uv, zoom: pane.viewport.zoom };
    if (pane.side === "scan" && known) {
      const ray = controller.sides.scan.toWorld(uv);
      const apart = Math.hypot(...ray.map((value, k) => value - known.ray[k]));
      // until the next answer the last one is shown, unless the pointer has moved far
      if (apart < SAME_POINT_RAD) Object.assign(readout, { range_m: known.range_m, intensity: known.intensity, edge: known.edge });
    }
    controller.view.set({ readout });
    pane.invalidate("live");
  });

  const probe = throttled(async (ray) => {
    const { range_m, intensity, edge } = await controller.ask("probe", { scan: ray });
    known = { ray, range_m, intensity, edge };
    if (at && controller.view.get().readout) show();
  }, INTERVAL_MS);

  return (pane, uv) => {
    at = { pane, uv };
    if (pane.side === "scan") probe(controller.sides.scan.toWorld(uv));
    show();
  };
};
