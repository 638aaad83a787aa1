/** Moves both panes to a match or a pixel that another part of the page refers to. */

import { other } from "./picking.js";
import { viewShowing } from "./projection.js";
import { revealing } from "./viewport.js";

const POINT_ZOOM = 2;

/** @param {import("./controller.js").Controller} controller */
export const listenToReveals = (controller) => {
  const { view } = controller;

  const show = (side, uvs, least) => {
    const pane = controller.panes[side];
    const seen = uvs.filter(Boolean);
    if (seen.length === 0 || !pane.extent || pane.size[0] === 0) return;
    pane.glideTo(revealing(pane.viewport, pane.size, seen, least), "page");
  };

  const revealMatch = (id) => {
    const pick = controller.pick(id);
    if (!pick) return;
    const { scan } = controller.sides.scan;
    if (scan) {
      const index = viewShowing(scan.views, pick.scan, controller.sides.scan.index);
      if (index !== controller.sides.scan.index) view.set({ scan: { view: index } });
    }
    for (const side of ["scan", "photo"]) {
      if (controller.sides[side].extent) show(side, pick[side].map((world) => controller.sides[side].toPixel(world)), 1);
    }
  };

  const revealPixel = async ({ side, uv }) => {
    show(side, [uv], POINT_ZOOM);
    controller.mark(side, uv);
    if (!controller.posed) return;
    const world = controller.sides[side].toWorld(uv);
    try {
      const answer = await controller.ask("predict", { photo: controller.store.shown(), side, [side === "scan" ? "scan" : "photo_uv"]: [world] });
      const partner = (answer.photo_uv ?? answer.scan)?.[0];
      const there = partner && controller.sides[other(side)].toPixel(partner);
      if (!there) return;
      show(other(side), [there], POINT_ZOOM);
      controller.mark(other(side), there);
    } catch {
      return; // the other pane stays where it is
    }
  };

  view.on((state, changed) => {
    if (changed.has("reveal") && state.reveal !== null) {
      revealMatch(state.reveal);
      view.set({ reveal: null });
    }
    if (changed.has("reveal_uv") && state.reveal_uv !== null) {
      const { reveal_uv: target } = state;
      view.set({ reveal_uv: null });
      revealPixel(target);
    }
  });
};
