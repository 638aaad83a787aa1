/** Linked panes: when one is moved by hand, the other follows to the corresponding place under the shown pose. */

import { throttled } from "../ui/throttle.js";
import { allowed, centredOn, fitted, middle } from "./viewport.js";

const INTERVAL_MS = 100;

/** @param {import("./controller.js").Controller} controller */
export const linkPanes = (controller) => {
  /** @param {import("./pane.js").Pane} from the pane that was moved */
  const lead = async (from) => {
    const photo = controller.store.shown();
    if (!controller.view.get().linked || !controller.posed || photo === null) return;
    const to = controller.panes[from.side === "scan" ? "photo" : "scan"];
    if (!from.extent || !to.extent) return;
    const centre = controller.sides[from.side].toWorld(middle(from.viewport, from.size));
    const given = from.side === "scan" ? { scan: [centre] } : { photo_uv: [centre] };
    const answer = await controller.ask("predict", { photo, side: from.side, ...given });
    const world = (answer.photo_uv ?? answer.scan)?.[0];
    const uv = world && controller.sides[to.side].toPixel(world);
    if (!uv || to.size[0] === 0) return;
    const zoom = allowed(fitted(to.size, to.extent).zoom * from.relativeZoom, to.size, to.extent);
    to.place(centredOn(uv, zoom, to.size), "link");
  };
  const follow = throttled(lead, INTERVAL_MS);

  for (const pane of Object.values(controller.panes)) pane.onMove((moved, by) => by === "hand" && follow(moved));
  controller.view.on((state, changed) => changed.has("linked") && state.linked && follow(controller.panes[controller.active]));
};
