/** Brings a match or a place into sight, in both panes, when something elsewhere on the page points to it. */

import { other } from "./picking.js";
import { viewShowing } from "./projection.js";
import { revealing } from "./viewport.js";

const PLACE_ZOOM = 2;

/** @param {import("./controller.js").Desk} desk */
export const listenToReveals = (desk) => {
  const { view } = desk;

  const show = (side, uvs, least) => {
    const pane = desk.panes[side];
    const seen = uvs.filter(Boolean);
    if (seen.length === 0 || !pane.extent || pane.size[0] === 0) return;
    pane.glideTo(revealing(pane.viewport, pane.size, seen, least), "page");
  };

  const match = (id) => {
    const pick = desk.pick(id);
    if (!pick) return;
    const { scan } = desk.sides.scan;
    if (scan) {
      const index = viewShowing(scan.views, pick.scan, desk.sides.scan.index);
      if (index !== desk.sides.scan.index) view.set({ scan: { view: index } });
    }
    for (const side of ["scan", "photo"]) {
      if (desk.sides[side].extent) show(side, pick[side].map((world) => desk.sides[side].toPixel(world)), 1);
    }
  };

  const place = async ({ side, uv }) => {
    show(side, [uv], PLACE_ZOOM);
    desk.mark(side, uv);
    if (!desk.posed) return;
    const world = desk.sides[side].toWorld(uv);
    try {
      const answer = await desk.ask("predict", { photo: desk.store.shown(), side, [side === "scan" ? "scan" : "photo_uv"]: [world] });
      const partner = (answer.photo_uv ?? answer.scan)?.[0];
      const there = partner && desk.sides[other(side)].toPixel(partner);
      if (!there) return;
      show(other(side), [there], PLACE_ZOOM);
      desk.mark(other(side), there);
    } catch {
      return; // the other pane stays where it is
    }
  };

  view.on((state, changed) => {
    if (changed.has("reveal") && state.reveal !== null) {
      match(state.reveal);
      view.set({ reveal: null });
    }
    if (changed.has("reveal_uv") && state.reveal_uv !== null) {
      const { reveal_uv: told } = state;
      view.set({ reveal_uv: null });
      place(told);
    }
  });
};
