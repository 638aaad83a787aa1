/** Both panes at the same place: when one is moved by hand, the other follows to where the pose says it is. */

import { throttled } from "../ui/throttle.js";
import { allowed, centredOn, fitted, middle } from "./viewport.js";

const EVERY_MS = 100;

/** @param {import("./controller.js").Desk} desk */
export const linkPanes = (desk) => {
  const follow = throttled(async (from) => {
    if (!desk.view.get().linked || !desk.posed) return;
    const to = desk.panes[from.side === "scan" ? "photo" : "scan"];
    if (!from.extent || !to.extent) return;
    const centre = desk.sides[from.side].toWorld(middle(from.viewport, from.size));
    const given = from.side === "scan" ? { scan: [centre] } : { photo_uv: [centre] };
    const answer = await desk.ask("predict", { photo: desk.store.shown(), side: from.side, ...given });
    const world = (answer.photo_uv ?? answer.scan)?.[0];
    const uv = world && desk.sides[to.side].toPixel(world);
    if (!uv || to.size[0] === 0) return;
    const zoom = allowed(fitted(to.size, to.extent).zoom * from.relativeZoom, to.size, to.extent);
    to.place(centredOn(uv, zoom, to.size), "link");
  }, EVERY_MS);

  for (const pane of Object.values(desk.panes)) pane.onMove((moved, by) => by === "hand" && follow(moved));
  desk.view.on((state, changed) => changed.has("linked") && state.linked && follow(desk.panes[desk.active]));
};
