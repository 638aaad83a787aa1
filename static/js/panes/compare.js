/** The scan, projected into the photograph's camera, over the photograph: blend, swipe, checkerboard or edges. */

import { element } from "../ui/dom.js";
import { drawPicture } from "./picture_layer.js";

/** @typedef {import("./viewport.js").Viewport} Viewport */

const SQUARE_PX = 64;
const SWIPE_STEP = 0.01;

/**
 * @param {number} zoom
 * @returns {number} side of a checkerboard square in image pixels: a power of two, about `SQUARE_PX` on the screen
 */
export const squareSide = (zoom) => 2 ** Math.round(Math.log2(SQUARE_PX / zoom));

/** @param {Viewport} viewport @param {readonly number[]} size @returns {Path2D} every other square of the visible part */
const checkerboard = (viewport, size) => {
  const side = squareSide(viewport.zoom) * viewport.zoom;
  const path = new Path2D();
  /** @param {number} at */
  const first = (at) => Math.floor(-at / side);
  for (let row = first(viewport.y); row * side + viewport.y < size[1]; row++) {
    for (let column = first(viewport.x); column * side + viewport.x < size[0]; column++) {
      if ((row + column) % 2 === 0) path.rect(column * side + viewport.x, row * side + viewport.y, side, side);
    }
  }
  return path;
};

/**
 * Draw the overlay.
 * @param {CanvasRenderingContext2D} context in CSS pixels of the pane
 * @param {import("./viewport.js").Viewport} viewport
 * @param {readonly number[]} size of the pane
 * @param {NonNullable<import("./picture_layer.js").Slot["shown"]>} picture
 * @param {readonly number[]} extent width and height of the photograph
 * @param {{overlay: string, blend: number, swipe_x: number}} how `swipe_x`: position of the swipe, CSS pixels
 * @param {boolean} smooth
 */
export const drawCompare = (context, viewport, size, picture, extent, { overlay, blend, swipe_x }, smooth) => {
  context.save();
  if (overlay === "blend" || overlay === "edges") context.globalAlpha = blend;
  if (overlay === "swipe") {
    context.beginPath();
    context.rect(0, 0, swipe_x, size[1]);
    context.clip();
  }
  if (overlay === "checker") context.clip(checkerboard(viewport, size));
  drawPicture(context, viewport, size, picture, extent, smooth);
  context.restore();
};

/**
 * Mount the bar of the swipe; the scan is shown to its left.
 * @param {import("./controller.js").Controller} controller
 */
export const mountSwipe = (controller) => {
  const pane = controller.panes.photo;
  const range = { "aria-label": "Swipe between scan and photograph", "aria-valuemin": 0, "aria-valuemax": 100 };
  const bar = element("div", { class: "pane-swipe", role: "slider", tabIndex: 0, ...range });
  pane.body.append(bar);
  /** @param {number} swipe */
  const set = (swipe) => controller.view.set({ photo: { swipe: Math.min(1, Math.max(0, swipe)) } });

  bar.addEventListener("pointerdown", (event) => {
    event.stopPropagation();
    bar.setPointerCapture(event.pointerId);
  });
  bar.addEventListener("pointermove", (event) => {
    if (!bar.hasPointerCapture(event.pointerId)) return;
    event.stopPropagation();
    set(pane.at(event)[0] / pane.size[0]);
  });
  bar.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: -SWIPE_STEP, ArrowDown: -SWIPE_STEP, ArrowRight: SWIPE_STEP, ArrowUp: SWIPE_STEP }[event.key];
    if (!step) return;
    event.preventDefault();
    set(controller.view.get().photo.swipe + step * (event.shiftKey ? 10 : 1));
  });

  const show = () => {
    const { overlay, swipe } = controller.view.get().photo;
    bar.hidden = overlay !== "swipe" || !controller.posed;
    bar.style.setProperty("left", `${100 * swipe}%`);
    bar.setAttribute("aria-valuenow", String(Math.round(100 * swipe)));
  };
  controller.view.on((_, changed) => changed.has("photo") && show());
  controller.store.watch(["poses:*", "shown"], show);
  show();
};
