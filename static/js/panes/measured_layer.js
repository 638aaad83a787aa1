/** Drawing of measurements over a picture: white lines with their values, on a dark halo. */

import { stamp, strokeHaloed } from "./symbols.js";
import { toScreen } from "./viewport.js";

/**
 * @typedef {import("./viewport.js").Viewport} Viewport
 * @typedef {import("./colors.js").Look} Look
 */

const WIDTH = 1.75;
const CHOSEN_WIDTH = 3;
const LABEL_PX = 6;

/**
 * @param {import("../state/measuring.js").Measurement[]} measurements
 * @param {import("./sides.js").ScanSide | import("./sides.js").PhotoSide} side
 * @typedef {{id: string, text: string, ends: number[][], lines: (number[] | null)[][]}} MeasuredMark in pixels of the picture
 * @returns {MeasuredMark[]}
 */
export const measuredMarks = (measurements, side) =>
  measurements.flatMap(({ id, name, kind, value, station, drawn, in_photo: photos }) => {
    const ofScan = (/** @type {string} */ shown) => (shown === station ? drawn : null);
    const rows = side.name === "scan" ? ofScan(side.station) : side.id === null ? null : photos[side.id];
    if (!rows) return [];
    /** @param {number[] | null} at */
    const pixel = (at) => at && side.toPixel(at);
    const ends = rows.ends.map(pixel).filter((uv) => uv !== null);
    const lines = rows.lines.map((line) => line.map(pixel));
    return ends.length || lines.some((line) => line.some(Boolean))
      ? [{ id, text: kind === "point" ? name : value.split(" ±")[0] + unitOf(value), ends, lines }]
      : [];
  });

/** @param {string} value @returns {string} the unit of a value such as '1.234 ± 0.003 m' */
const unitOf = (value) => (value.includes("°") ? "°" : value.includes("±") ? ` ${value.split(" ").at(-1)}` : "");

/** @param {import("./viewport.js").Viewport} viewport @param {(readonly number[] | null)[][]} lines */
const trace = (viewport, lines) => {
  const path = new Path2D();
  for (const line of lines) {
    let on = false;
    for (const uv of line) {
      const at = uv && toScreen(viewport, uv);
      if (at && on) path.lineTo(at[0], at[1]);
      else if (at) path.moveTo(at[0], at[1]);
      on = Boolean(at);
    }
  }
  return path;
};

/**
 * @param {Viewport} viewport
 * @param {MeasuredMark} mark
 * @returns {number[] | null} where a value is written: at the middle of the first line, or beside the point
 */
const labelAt = (viewport, { ends, lines }) => {
  const seen = lines.map((line) => line.filter((at) => at !== null)).find((line) => line.length > 1);
  const uv = seen ? seen[Math.floor(seen.length / 2)] : ends[0];
  return uv ? toScreen(viewport, uv) : null;
};

/**
 * @param {CanvasRenderingContext2D} context
 * @param {Look} look
 * @param {string} colour
 * @param {string} text
 * @param {readonly number[]} at
 */
const write = (context, look, colour, text, at) => {
  const [x, y] = at;
  context.font = look.font;
  context.textAlign = "center";
  context.textBaseline = "bottom";
  context.lineJoin = "round";
  context.lineWidth = 3.5 * look.scale;
  context.strokeStyle = look.halo;
  context.strokeText(text, x, y - LABEL_PX * look.scale);
  context.fillStyle = colour;
  context.fillText(text, x, y - LABEL_PX * look.scale);
};

/**
 * @param {CanvasRenderingContext2D} context
 * @param {ReturnType<typeof measuredMarks>} marks
 * @param {string | null} chosen id of the selected one
 * @param {Viewport} viewport
 * @param {Look} look
 */
export const drawMeasured = (context, viewport, marks, chosen, look) => {
  context.lineCap = "round";
  for (const mark of marks) {
    const width = mark.id === chosen ? CHOSEN_WIDTH : WIDTH;
    strokeHaloed(context, trace(viewport, mark.lines), look, { colour: look.ink, width });
    const ends = mark.ends.map(([u, v]) => toScreen(viewport, [u, v]));
    stamp(context, look, ends, { colour: look.ink, halo: look.halo, radius: mark.id === chosen ? 4.5 : 3, width: 1.5, dot: 0.75 });
  }
  for (const mark of marks) {
    const at = labelAt(viewport, mark);
    if (at) write(context, look, look.ink, mark.text, at);
  }
};

/**
 * Draw what is being picked: points, dashed lines between them, and on to the pointer.
 * @param {(readonly number[] | null)[][]} runs pixels of points that were picked one after the other in this pane; null: out of view
 * @param {readonly number[] | null} pointer where the next point would be, if the last line goes on to it
 * @param {CanvasRenderingContext2D} context
 * @param {Viewport} viewport
 * @param {Look} look
 */
export const drawPicked = (context, viewport, runs, pointer, look) => {
  const lines = runs.map((run, k) => (pointer && k === runs.length - 1 ? [...run, pointer] : run));
  context.lineCap = "round";
  strokeHaloed(context, trace(viewport, lines), look, { colour: look.ink, width: WIDTH, dash: [6, 5] });
  const ends = runs.flat().filter((uv) => uv !== null).map(([u, v]) => toScreen(viewport, [u, v]));
  stamp(context, look, ends, { colour: look.ink, halo: look.halo, radius: 4, width: 1.5, dot: 1 });
};
