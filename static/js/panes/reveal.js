/** Shows a match or a pixel that another part of the page refers to, on request, and gives the former view back. */

import { button } from "../ui/controls.js";
import { element, partOf, setText } from "../ui/dom.js";
import { other } from "./picking.js";
import { viewShowing } from "./projection.js";
import { filling, fitted, revealing, showSame } from "./viewport.js";

/**
 * @typedef {import("./picking.js").Side} Side
 * @typedef {import("../net/store.js").Pick} Pick
 * @typedef {import("../state/view.js").ViewState} ViewState
 */

const POINT_ZOOM = 2;
/** @type {Side[]} */
const SIDES = ["scan", "photo"];
/** @typedef {Record<Side, import("./viewport.js").Viewport> & {index: number, of: string | null}} Former */

/** @param {import("./controller.js").Controller} controller */
export const listenToReveals = (controller) => {
  const { view } = controller;
  /** What both panes showed before the first match was shown; null: the operator has moved them since. */
  /** @type {Former | null} */
  let former = null;
  /** @type {string | null} id of a match */
  let offered = null;

  /**
   * @param {Side} side
   * @param {(readonly number[] | null)[]} uvs
   * @param {number} least
   * @returns {import("./viewport.js").Viewport | null} where a pane moves to show pixels; null: it has no picture
   */
  const target = (side, uvs, least) => {
    const pane = controller.panes[side];
    const seen = uvs.filter((uv) => uv !== null);
    if (seen.length === 0 || !pane.extent || pane.size[0] === 0) return null;
    const found = revealing(pane.viewport, pane.size, seen, least);
    return found === pane.viewport ? found : filling(found, pane.size, pane.extent);
  };
  /** @param {Side} side @param {(readonly number[] | null)[]} uvs @param {number} least */
  const show = (side, uvs, least) => {
    const found = target(side, uvs, least);
    if (found) controller.panes[side].glideTo(found, "page");
  };

  /** @param {Pick} pick @returns {number} the view of the scan that shows a match best */
  const viewFor = (pick) => {
    const { scan, index } = controller.sides.scan;
    return scan ? viewShowing(scan.views, pick.scan, index) : index;
  };
  /** @param {Pick} pick @param {Side} side */
  const pixelsOf = (pick, side) => pick[side].map((world) => controller.sides[side].toPixel(world));

  /** @param {Pick} pick @param {Side} side @returns {boolean} whether a pane would have to move to show a match */
  const moves = (pick, side) => {
    const { extent } = controller.sides[side];
    if (!extent || (side === "scan" && viewFor(pick) !== controller.sides.scan.index)) return Boolean(extent);
    const found = target(side, pixelsOf(pick, side), 1);
    return found !== null && !showSame(found, controller.panes[side].viewport);
  };

  /** @param {string} id */
  const revealMatch = (id) => {
    const pick = controller.pick(id);
    if (!pick) return;
    if (former && !SIDES.some((side) => moves(pick, side))) {
      giveBack(); // the same key once more
      return;
    }
    former ??= { index: controller.sides.scan.index, of: controller.store.shown(), scan: controller.panes.scan.viewport, photo: controller.panes.photo.viewport };
    offered = null;
    const index = viewFor(pick);
    if (index !== controller.sides.scan.index) view.set({ scan: { view: index } });
    for (const side of SIDES) if (controller.sides[side].extent) show(side, pixelsOf(pick, side), 1);
    showOffers();
  };

  const giveBack = () => {
    const back = former;
    former = null;
    if (!back) return;
    if (back.index !== controller.sides.scan.index) view.set({ scan: { view: back.index } });
    for (const side of SIDES) {
      const pane = controller.panes[side];
      if (!pane.extent || pane.size[0] === 0) continue;
      if (showSame(back[side], fitted(pane.size, pane.extent))) pane.fit("page"); // which stays fitted in another window
      else pane.glideTo(back[side], "page");
    }
    showOffers();
  };

  const chips = SIDES.map((side) => {
    const look = button({ label: "Show the match", icon: "target", kind: "pane-button", act: () => offered && view.set({ reveal: offered }) });
    const back = button({ label: "Back to the former view", text: "Back", icon: "undo", title: "Back to the former view (Enter in the table)", kind: "pane-button", act: giveBack });
    const box = element("div", { class: "pane-offer", hidden: true }, look, back);
    controller.panes[side].body.append(box);
    return { side, look, back, box };
  });
  const showOffers = () => {
    const pick = offered === null ? null : controller.pick(offered);
    for (const { side, look, back, box } of chips) {
      const offers = pick && controller.picking.idle && moves(pick, side) ? pick : null;
      look.hidden = offers === null;
      if (offers) setText(partOf(look, "span"), `Show match ${offers.number}`);
      look.title = offers ? `Show match ${offers.number} in both pictures (Enter in the table)` : "";
      back.hidden = former === null || !controller.picking.idle;
      box.hidden = look.hidden && back.hidden;
    }
  };
  const forget = () => {
    former = null;
    showOffers();
  };
  for (const side of SIDES) controller.panes[side].onMove((_, by) => (by === "hand" && former ? forget() : undefined));
  controller.store.watch(["shown", "picks:*"], () => (former && former.of !== controller.store.shown() ? forget() : showOffers()));

  /** @param {NonNullable<ViewState["reveal_uv"]>} pixel */
  const revealPixel = async ({ side, uv }) => {
    show(side, [uv], POINT_ZOOM);
    controller.mark(side, uv);
    const photo = controller.store.shown();
    if (!controller.posed || photo === null) return;
    const world = controller.sides[side].toWorld(uv);
    try {
      const answer = await controller.ask("predict", { photo, side, [side === "scan" ? "scan" : "photo_uv"]: [world] });
      const partner = (answer.photo_uv ?? answer.scan)?.[0];
      const there = partner && controller.sides[other(side)].toPixel(partner);
      if (!there) return;
      show(other(side), [there], POINT_ZOOM);
      controller.mark(other(side), there);
    } catch {
      return; // the other pane stays where it is
    }
  };

  /** @param {NonNullable<ViewState["reveal_place"]>} place */
  const revealPlace = ({ ray, uv: there }) => {
    const { scan, index } = controller.sides.scan;
    if (!scan) return;
    const best = viewShowing(scan.views, [ray], index);
    if (best !== index) view.set({ scan: { view: best } });
    const places = { scan: controller.sides.scan.toPixel(ray), photo: there };
    for (const side of SIDES) {
      const uv = places[side];
      if (!uv) continue;
      show(side, [uv], POINT_ZOOM);
      controller.mark(side, uv);
    }
  };

  view.on((state, changed) => {
    if (changed.has("reveal_place") && state.reveal_place !== null) {
      const { reveal_place: place } = state;
      view.set({ reveal_place: null });
      revealPlace(place);
    }
    if (changed.has("selected") && offered !== null && !state.selected.has(offered)) offered = null;
    if (changed.has("offer") && state.offer !== null) {
      offered = state.offer;
      view.set({ offer: null, ...(former ? { reveal: offered } : {}) }); // once a match is shown, the next ones are, too
    }
    if (changed.has("reveal") && state.reveal !== null) {
      const { reveal } = state;
      view.set({ reveal: null });
      revealMatch(reveal);
    }
    if (changed.has("selected") || changed.has("offer")) showOffers();
    if (changed.has("reveal_uv") && state.reveal_uv !== null) {
      const { reveal_uv: target } = state;
      view.set({ reveal_uv: null });
      revealPixel(target);
    }
  });
};
