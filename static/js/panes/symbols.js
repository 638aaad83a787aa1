/** Symbols drawn over a picture: strokes with a halo, stamped rings and crosses, match numbers, corners, crosshair. */

import { TIE_FACTOR } from "../state/survey.js";
import { drawing } from "../ui/canvas.js";
import { colourOf } from "./colors.js";
import { toScreen } from "./viewport.js";

/**
 * @typedef {import("./viewport.js").Viewport} Viewport
 * @typedef {import("./colors.js").Look} Look
 * @typedef {import("./marks.js").Mark} Mark
 */

/**
 * Stroke a path over a dark halo.
 * @param {CanvasRenderingContext2D} context
 * @param {Path2D} path
 * @param {{scale: number, halo: string}} look
 * @param {{colour: string, width?: number, dash?: number[]}} line
 */
export const strokeHaloed = (context, path, look, { colour, width = 2, dash = [] }) => {
  const { scale } = look;
  context.setLineDash([]);
  context.lineWidth = (width + 2.5) * scale;
  context.strokeStyle = look.halo;
  context.stroke(path);
  context.setLineDash(dash.map((length) => length * scale));
  context.lineWidth = width * scale;
  context.strokeStyle = colour;
  context.stroke(path);
  context.setLineDash([]);
};

const SIDE_PX = 24;
const TAU = 2 * Math.PI;
/** @type {Map<string, ImageBitmap>} */
const stamps = new Map(); // ring and cross, rasterised once: of 500 matches the rings alone would cost more than all else

/**
 * @typedef {{colour: string, halo: string, radius: number, width: number, dash?: number[], dot?: number, cross?:
 *   number}} Stamp
 */

/** @param {CanvasRenderingContext2D | OffscreenCanvasRenderingContext2D} context @param {Stamp} symbol */
const drawStamp = (context, { colour, halo, radius, width, dash = [], dot = 0, cross = 0 }) => {
  const middle = SIDE_PX / 2;
  const path = new Path2D();
  if (radius > 0) path.arc(middle, middle, radius, 0, TAU);
  if (cross > 0) {
    path.moveTo(middle - cross, middle - cross);
    path.lineTo(middle + cross, middle + cross);
    path.moveTo(middle - cross, middle + cross);
    path.lineTo(middle + cross, middle - cross);
  }
  context.lineCap = "round";
  context.lineWidth = width + 2.5;
  context.strokeStyle = halo;
  context.stroke(path);
  context.setLineDash(dash);
  context.lineWidth = width;
  context.strokeStyle = colour;
  context.stroke(path);
  if (dot === 0) return;
  context.beginPath();
  context.arc(middle, middle, dot, 0, TAU);
  context.fillStyle = colour;
  context.fill();
};

/** Stamps have twice the screen's resolution, since they are placed between pixels. @param {Stamp} symbol @param {number} scale */
const stampOf = (symbol, scale) => {
  const ratio = 2 * scale * (window.devicePixelRatio || 1);
  const key = `${ratio} ${Object.values(symbol).join(" ")}`;
  let image = stamps.get(key);
  if (!image) {
    const side = Math.ceil(SIDE_PX * ratio);
    const canvas = new OffscreenCanvas(side, side);
    const context = drawing(canvas.getContext("2d", { willReadFrequently: true }));
    context.scale(ratio, ratio);
    drawStamp(context, symbol);
    image = canvas.transferToImageBitmap(); // a canvas would be copied each time that it is drawn
    stamps.set(key, image);
  }
  return image;
};

/**
 * Draw a stamp at each position.
 * @param {CanvasRenderingContext2D} context in CSS pixels
 * @param {{scale: number}} look
 * @param {(readonly number[])[]} positions
 * @param {Stamp} symbol
 */
export const stamp = (context, look, positions, symbol) => {
  if (positions.length === 0) return;
  const image = stampOf(symbol, look.scale);
  const side = SIDE_PX * look.scale;
  context.imageSmoothingEnabled = true;
  for (const [x, y] of positions) context.drawImage(image, x - side / 2, y - side / 2, side, side);
};

/**
 * @typedef {Pick<import("./marks.js").Mark, "id" | "number" | "kind">} Numbered
 * @typedef {{mark: Numbered, ends: (readonly number[] | null)[], line: (readonly number[])[] | null}} Labelled a match on the screen
 */

const LABEL = { width: 24, dx: 8, dy: -8 };
const KEPT_FREE_PX = 7;

/**
 * Draw a number over its halo.
 * @param {CanvasRenderingContext2D} context
 * @param {Look} look
 * @param {string} colour
 * @param {string} text
 * @param {readonly number[]} at
 */
const drawLabel = (context, look, colour, text, [x, y]) => {
  context.lineWidth = 3.5 * look.scale;
  context.strokeStyle = look.halo;
  context.strokeText(text, x, y);
  context.fillStyle = colour;
  context.fillText(text, x, y);
};

/**
 * @param {Pick<Labelled, "ends" | "line">} match
 * @param {number} scale
 * @returns {number[] | null} position of a match's number: above its first visible end, away from its line
 */
const labelPosition = ({ ends, line }, scale) => {
  const at = ends.find((end) => end !== null) ?? line?.[0];
  if (!at) return null;
  const far = line && (Math.hypot(line[1][0] - at[0], line[1][1] - at[1]) > 1 ? line[1] : line[0]);
  const rightwards = far && far[0] > at[0] && far[1] < at[1];
  return [at[0] + (rightwards ? -LABEL.dx - 9 : LABEL.dx) * scale, at[1] + LABEL.dy * scale];
};

/** @param {number} number @param {readonly number[]} at @param {number} scale @returns {number[]} left, top, right, bottom of a match's number */
export const labelBox = (number, [x, y], scale) => [x, y - 10 * scale, x + 8 * scale * String(number).length, y];

/**
 * Place numbers where there is room: not over each other, nor over the end of another match.
 * @param {Labelled[]} shown
 * @param {Look} look
 * @returns {(number[] | null)[]} the position of each; null where there is no room
 */
export const placeLabels = (shown, look) => {
  const { scale } = look;
  const cell = LABEL.width * scale;
  /** @type {Map<string, [readonly number[], string][]>} */
  const taken = new Map();
  /** @param {readonly number[]} box */
  const cellsOf = ([left, top, right, bottom]) => {
    const cells = [];
    for (let x = Math.floor(left / cell); x <= Math.floor(right / cell); x++) {
      for (let y = Math.floor(top / cell); y <= Math.floor(bottom / cell); y++) cells.push(`${x},${y}`);
    }
    return cells;
  };
  /** @param {readonly number[]} box @param {string} owner */
  const take = (box, owner) => {
    for (const name of cellsOf(box)) {
      const there = taken.get(name) ?? [];
      taken.set(name, there);
      there.push([box, owner]);
    }
  };
  /** @param {readonly number[]} box @param {string} owner */
  const isFree = (box, owner) =>
    cellsOf(box).every((name) =>
      (taken.get(name) ?? []).every(
        ([other, of]) => of === owner || other[0] >= box[2] || box[0] >= other[2] || other[1] >= box[3] || box[1] >= other[3],
      ),
    );
  const reach = KEPT_FREE_PX * scale;
  for (const { mark, ends } of shown) {
    for (const [x, y] of ends.filter((end) => end !== null)) take([x - reach, y - reach, x + reach, y + reach], mark.id);
  }
  /** @type {(number[] | null)[]} */
  const places = shown.map(() => null);
  /** @param {Mark["kind"]} kind */
  const place = (kind) =>
    shown.forEach((entry, k) => {
      const at = entry.mark.kind === kind ? labelPosition(entry, scale) : null;
      if (!at) return;
      const box = labelBox(entry.mark.number, at, scale);
      if (kind === "point" && !isFree(box, entry.mark.id)) return;
      take(box, entry.mark.id);
      places[k] = at;
    });
  place("line");
  place("point");
  return places;
};

/**
 * Draw the numbers of matches that `placeLabels` has found room for.
 * @param {CanvasRenderingContext2D} context
 * @param {(Labelled & {label: number[] | null})[]} labelled
 * @param {Look} look
 */
export const drawLabels = (context, labelled, look) => {
  context.font = look.font;
  context.textBaseline = "alphabetic";
  context.lineJoin = "round";
  for (const kind of ["line", "point"]) {
    for (const { mark, label } of labelled) {
      if (label && mark.kind === kind) drawLabel(context, look, colourOf(look, mark.number), String(mark.number), label);
    }
  }
};

/**
 * Draw the number of one match, whatever it covers.
 * @param {CanvasRenderingContext2D} context
 * @param {Labelled} entry
 * @param {Look} look
 */
export const drawNumber = (context, entry, look) => {
  const at = labelPosition(entry, look.scale);
  if (!at) return;
  context.font = look.font;
  context.lineJoin = "round";
  drawLabel(context, look, colourOf(look, entry.mark.number), String(entry.mark.number), at);
};

/**
 * Draw detected corners: small plus signs.
 * @param {CanvasRenderingContext2D} context
 * @param {Viewport} viewport
 * @param {readonly number[]} size
 * @param {number[][]} corners
 * @param {Look} look
 */
export const drawCorners = (context, viewport, size, corners, look) => {
  const path = new Path2D();
  const reach = 3 * look.scale;
  for (const uv of corners) {
    const [x, y] = toScreen(viewport, uv);
    if (x < -reach || y < -reach || x > size[0] + reach || y > size[1] + reach) continue;
    path.moveTo(x - reach, y);
    path.lineTo(x + reach, y);
    path.moveTo(x, y - reach);
    path.lineTo(x, y + reach);
  }
  context.lineCap = "butt";
  context.lineWidth = 3 * look.scale;
  context.strokeStyle = "rgba(6, 8, 12, .6)";
  context.stroke(path);
  context.lineWidth = look.scale;
  context.strokeStyle = look.dim;
  context.stroke(path);
};

const LONGEST_PX = 40;

/**
 * Draw ties with other photographs: a dot and a needle of its residual for each that agrees, a cross for each that was
 * left out.
 * @param {CanvasRenderingContext2D} context
 * @param {Viewport} viewport
 * @param {readonly number[]} size
 * @param {number[][]} ties
 * @param {Look} look
 */
export const drawTies = (context, viewport, size, ties, look) => {
  const agree = new Path2D(), out = new Path2D();
  const [dot, cross] = [2 * look.scale, 3.5 * look.scale];
  for (const [u, v, du, dv, agrees] of ties) {
    const [x, y] = toScreen(viewport, [u, v]);
    if (x < -LONGEST_PX || y < -LONGEST_PX || x > size[0] + LONGEST_PX || y > size[1] + LONGEST_PX) continue;
    if (agrees) {
      const length = TIE_FACTOR * viewport.zoom * Math.hypot(du, dv);
      const share = length > LONGEST_PX ? LONGEST_PX / length : 1;
      agree.moveTo(x + dot, y);
      agree.arc(x, y, dot, 0, TAU);
      agree.moveTo(x, y);
      agree.lineTo(x + share * TIE_FACTOR * viewport.zoom * du, y + share * TIE_FACTOR * viewport.zoom * dv);
    } else {
      out.moveTo(x - cross, y - cross);
      out.lineTo(x + cross, y + cross);
      out.moveTo(x - cross, y + cross);
      out.lineTo(x + cross, y - cross);
    }
  }
  strokeHaloed(context, agree, look, { colour: look.matches[1], width: 1.25 });
  strokeHaloed(context, out, look, { colour: look.warn, width: 1.25 });
};

/**
 * Draw a crosshair.
 * @param {CanvasRenderingContext2D} context
 * @param {readonly number[]} at
 * @param {Look} look
 * @param {number} [reach]
 */
export const drawCrosshair = (context, [x, y], look, reach = 12) => {
  const path = new Path2D();
  for (const [dx, dy] of [[-1, 0], [1, 0], [0, -1], [0, 1]]) {
    path.moveTo(x + dx * 3 * look.scale, y + dy * 3 * look.scale);
    path.lineTo(x + dx * reach * look.scale, y + dy * reach * look.scale);
  }
  strokeHaloed(context, path, look, { colour: look.ink, width: 1.25 });
};

/**
 * Draw where a point or a line would snap to: a small diamond at each end, and the edge between them.
 * @param {CanvasRenderingContext2D} context
 * @param {number[][]} ends
 * @param {Look} look
 */
export const drawGhost = (context, ends, look) => {
  const path = new Path2D();
  const reach = 6 * look.scale;
  if (ends.length === 2) {
    path.moveTo(ends[0][0], ends[0][1]);
    path.lineTo(ends[1][0], ends[1][1]);
  }
  for (const [x, y] of ends) {
    path.moveTo(x - reach, y);
    path.lineTo(x, y - reach);
    path.lineTo(x + reach, y);
    path.lineTo(x, y + reach);
    path.closePath();
  }
  strokeHaloed(context, path, look, { colour: look.warn, width: 1.5 });
};

/**
 * Draw the frame of a selection.
 * @param {CanvasRenderingContext2D} context
 * @param {readonly number[]} a
 * @param {readonly number[]} b
 * @param {Look} look
 */
export const drawFrame = (context, a, b, look) => {
  const path = new Path2D();
  path.rect(Math.min(a[0], b[0]), Math.min(a[1], b[1]), Math.abs(a[0] - b[0]), Math.abs(a[1] - b[1]));
  strokeHaloed(context, path, look, { colour: look.ink, width: 1, dash: [4, 3] });
};
