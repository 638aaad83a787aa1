/** Draws the scan, as the photograph's camera sees it, over the photograph: blended, swiped, in squares, or its edges. */

import { drawPicture } from "./picture_layer.js";

const SQUARE_PX = 64;

/** @returns {number} side of the squares in pixels of the photograph: a power of two, about `SQUARE_PX` on the screen */
export const squareSide = (zoom) => 2 ** Math.round(Math.log2(SQUARE_PX / zoom));

/** @returns {Path2D} every other square of those in sight */
const squares = (viewport, size) => {
  const side = squareSide(viewport.zoom) * viewport.zoom;
  const path = new Path2D();
  const first = (at) => Math.floor(-at / side);
  for (let row = first(viewport.y); row * side + viewport.y < size[1]; row++) {
    for (let column = first(viewport.x); column * side + viewport.x < size[0]; column++) {
      if ((row + column) % 2 === 0) path.rect(column * side + viewport.x, row * side + viewport.y, side, side);
    }
  }
  return path;
};

/**
 * @param {CanvasRenderingContext2D} context in CSS pixels of the pane
 * @param {import("./viewport.js").Viewport} viewport
 * @param {readonly number[]} size of the pane
 * @param {import("./picture_layer.js").Picture} picture
 * @param {readonly number[]} extent width and height of the photograph
 * @param {{overlay: string, blend: number, swipe_x: number}} how `swipe_x`: where the swipe stands, CSS pixels
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
  if (overlay === "checker") context.clip(squares(viewport, size));
  drawPicture(context, viewport, size, picture, extent, smooth);
  context.restore();
};
