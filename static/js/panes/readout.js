/** What is under the cursor, for the status bar: pixel, zoom, and on the scan the range and intensity there. */

import { throttled } from "../ui/throttle.js";

const EVERY_MS = 100;
const SAME_PLACE = 1e-3;

/**
 * @param {import("./controller.js").Desk} desk
 * @returns {(pane: import("./pane.js").Pane, uv: number[]) => void} tells that the cursor is there
 */
export const readoutOf = (desk) => {
  let known = null;
  let frame = 0;
  let at = null;

  const show = () => {
    frame = 0;
    if (!at) return;
    const { pane, uv } = at;
    const readout = { side: pane.side, uv, zoom: pane.viewport.zoom };
    if (pane.side === "scan" && known) {
      const ray = desk.sides.scan.toWorld(uv);
      const apart = Math.hypot(...ray.map((value, k) => value - known.ray[k]));
      // The last answer while the next is on its way, unless the cursor has gone far.
      if (apart < 20 * SAME_PLACE) Object.assign(readout, { range_m: known.range_m, intensity: known.intensity });
    }
    desk.view.set({ readout });
  };

  const probe = throttled(async (ray) => {
    const { range_m, intensity } = await desk.ask("probe", { scan: ray });
    known = { ray, range_m, intensity };
    if (at && desk.view.get().readout) show();
  }, EVERY_MS);

  return (pane, uv) => {
    at = { pane, uv };
    if (pane.side === "scan") probe(desk.sides.scan.toWorld(uv));
    frame ||= requestAnimationFrame(show);
  };
};
