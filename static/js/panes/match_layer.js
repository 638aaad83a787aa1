/**
 * Draws matches over a picture. Strokes are as wide at every zoom, and each lies on a dark halo, so that it reads on any
 * picture. One path per style and colour: five hundred matches cost a dozen strokes.
 */

import { drawLabels, drawNumber } from "./labels.js";
import { colourOf } from "./colors.js";
import { stamp } from "./stamps.js";
import { toPixel, toScreen } from "./viewport.js";

/**
 * @typedef {import("./marks.js").Mark} Mark
 * @typedef {import("./viewport.js").Viewport} Viewport
 * @typedef {CanvasRenderingContext2D} Context
 */

export const RING_PX = 5;
const POINT_PX = 4;
const BEYOND_PX = 24;
const SAMPLES_APART_PX = 7;
const RESIDUAL_SEEN_PX = 3;
const CROSS_PX = 5;
const WIDTHS = { on: 2, off: 1.25, rejected: 4 };
const DASHES = { on: [], off: [4, 4], rejected: [] };
const DOTS = { line: 1, point: 1.25 };
const RADII = { line: RING_PX, point: POINT_PX };
const TAU = 2 * Math.PI;

const ring = (path, [x, y], radius) => {
  path.moveTo(x + radius, y);
  path.arc(x, y, radius, 0, TAU);
};

const cross = (path, [x, y], reach) => {
  path.moveTo(x - reach, y - reach);
  path.lineTo(x + reach, y + reach);
  path.moveTo(x - reach, y + reach);
  path.lineTo(x + reach, y - reach);
};

/** The line from ring to ring: what an end stands on stays visible inside its ring. */
const between = (path, a, b, ringed, radius) => {
  const length = Math.hypot(b[0] - a[0], b[1] - a[1]);
  if (length < 0.5) return;
  const cut = (end) => (ringed[end] && length > 3 * radius ? radius / length : 0);
  const at = (t) => [a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1])];
  path.moveTo(...at(cut(0)));
  path.lineTo(...at(1 - cut(1)));
};

/** Stroke a path upon its halo. */
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

/** @returns {number[]} left, top, right, bottom of what can be seen, in pixels: told before anything is worked out */
const sightOf = (viewport, size) => [
  ...toPixel(viewport, [-BEYOND_PX, -BEYOND_PX]),
  ...toPixel(viewport, [size[0] + BEYOND_PX, size[1] + BEYOND_PX]),
];

/** @returns {boolean} whether anything of what lies between the pixels can be seen */
const inSight = (uvs, sight) => {
  let [left, right, top, bottom] = [Infinity, -Infinity, Infinity, -Infinity];
  for (const uv of uvs) {
    if (!uv) continue;
    left = Math.min(left, uv[0]);
    right = Math.max(right, uv[0]);
    top = Math.min(top, uv[1]);
    bottom = Math.max(bottom, uv[1]);
  }
  return right >= sight[0] && bottom >= sight[1] && left <= sight[2] && top <= sight[3];
};

/** A mark with its places in the pane. */
const onScreen = (mark, viewport) => ({
  mark,
  ends: mark.ends.map((uv) => uv && toScreen(viewport, uv)),
  line: mark.line && mark.line.map((uv) => toScreen(viewport, uv)),
});

/** Where the cross of a rejected match stands. */
const crossPlace = ({ ends, line }) => (line ? [(line[0][0] + line[1][0]) / 2, (line[0][1] + line[1][1]) / 2] : ends[0]);

const trace = ({ mark, ends, line }, { scale }, strokes, rings, dots) => {
  if (line) between(strokes, line[0], line[1], ends, RING_PX * scale);
  for (const end of ends) {
    if (!end) continue;
    ring(rings, end, RADII[mark.kind] * scale);
    ring(dots, end, DOTS[mark.kind] * scale);
  }
  const at = mark.state === "rejected" ? crossPlace({ ends, line }) : null;
  if (at) cross(rings, at, (CROSS_PX + 1) * scale);
};

/** Draw the samples along a line; those without a range are open circles with a cross through them. */
export const drawSamples = (context, viewport, samples, look, colour) => {
  if (samples.length < 2) return;
  const places = samples.map(({ uv }) => toScreen(viewport, uv));
  const [first, last] = [places[0], places.at(-1)];
  const apart = Math.hypot(last[0] - first[0], last[1] - first[1]) / (samples.length - 1);
  if (apart < SAMPLES_APART_PX * look.scale) return;
  stamp(context, look, places.filter((_, k) => samples[k].has_range), { colour, halo: look.halo, radius: 1.2, width: 2 });
  stamp(context, look, places.filter((_, k) => !samples[k].has_range), { colour: look.ink, halo: look.halo, radius: 4, width: 1, cross: 2.8 });
};

/** Hairlines from where the pose puts a match to where it was picked, where that can be seen. */
const traceResidual = (path, tips, viewport, predicted, ends) => {
  predicted.forEach((uv, k) => {
    if (!uv || !ends[k]) return;
    const at = toScreen(viewport, uv);
    if (Math.hypot(at[0] - ends[k][0], at[1] - ends[k][1]) < RESIDUAL_SEEN_PX) return;
    path.moveTo(...ends[k]);
    path.lineTo(...at);
    tips.push(at);
  });
};

/**
 * Draw matches, number and all.
 * @param {Context} context in CSS pixels of the pane
 * @param {Viewport} viewport
 * @param {readonly number[]} size of the pane
 * @param {Mark[]} marks
 * @param {ReturnType<typeof import("./colors.js").readLook>} look
 * @param {{residuals?: boolean}} [options] `residuals`: also where the pose puts them
 */
export const drawMatches = (context, viewport, size, marks, look, { residuals = true } = {}) => {
  const sight = sightOf(viewport, size);
  const shown = marks.filter((mark) => inSight(mark.line ?? mark.ends, sight)).map((mark) => onScreen(mark, viewport));
  const buckets = new Map();
  for (const entry of shown) {
    const { number, state, kind } = entry.mark;
    const key = `${state} ${kind} ${(number - 1) % look.matches.length}`;
    if (!buckets.has(key)) {
      buckets.set(key, { state, kind, colour: colourOf(look, number), strokes: new Path2D(), ends: [], crosses: [] });
    }
    const bucket = buckets.get(key);
    if (entry.line) between(bucket.strokes, entry.line[0], entry.line[1], entry.ends, RING_PX * look.scale);
    bucket.ends.push(...entry.ends.filter(Boolean));
    if (state === "rejected") bucket.crosses.push(crossPlace(entry));
  }
  context.lineCap = "round";
  for (const { state, kind, colour, strokes, ends, crosses } of buckets.values()) {
    context.globalAlpha = state === "off" ? 0.75 : 1;
    if (kind === "line") strokeHaloed(context, strokes, look, { colour, width: WIDTHS[state], dash: DASHES[state] });
    if (kind === "line" && state === "rejected") {
      context.lineWidth = 1.75 * look.scale;
      context.strokeStyle = look.halo;
      context.stroke(strokes);
    }
    const sign = { colour, halo: look.halo, radius: RADII[kind], width: 1.5, dash: state === "off" ? [3, 3] : [], dot: DOTS[kind] };
    stamp(context, look, ends, sign);
    stamp(context, look, crosses.filter(Boolean), { colour, halo: look.halo, radius: 0, width: 1.5, cross: CROSS_PX + 1 });
  }
  context.globalAlpha = 1;
  for (const { mark } of shown) if (mark.state !== "off") drawSamples(context, viewport, mark.samples, look, colourOf(look, mark.number));
  if (residuals) {
    const [hairs, tips] = [new Path2D(), []];
    for (const { mark, ends } of shown) traceResidual(hairs, tips, viewport, mark.predicted, ends);
    strokeHaloed(context, hairs, look, { colour: look.ink, width: 1 });
    stamp(context, look, tips, { colour: look.ink, halo: look.halo, radius: 2.5, width: 1 });
  }
  drawLabels(context, shown, look);
};

/**
 * Draw one match again, on top of the rest: under the pointer, selected, or being moved.
 * @param {{hovered?: boolean, selected?: boolean, end?: number | null}} how
 */
export const drawMark = (context, viewport, mark, look, { hovered = false, selected = false, end = null }) => {
  const entry = onScreen(mark, viewport);
  const colour = colourOf(look, mark.number);
  const [strokes, rings, dots, outer] = [new Path2D(), new Path2D(), new Path2D(), new Path2D()];
  trace(entry, look, strokes, rings, dots);
  context.lineCap = "round";
  if (hovered || selected) {
    context.lineWidth = (WIDTHS[mark.state] + (hovered ? 6 : 5)) * look.scale;
    context.strokeStyle = look.ink;
    context.globalAlpha = hovered ? 0.9 : 0.6;
    context.stroke(strokes);
    context.globalAlpha = 1;
  }
  strokeHaloed(context, strokes, look, { colour, width: WIDTHS[mark.state] + (hovered ? 0.75 : 0), dash: DASHES[mark.state] });
  strokeHaloed(context, rings, look, { colour, width: 2 });
  drawSamples(context, viewport, mark.samples, look, colour);
  if (selected || hovered) for (const at of entry.ends) if (at) ring(outer, at, (RING_PX + 3.5) * look.scale);
  strokeHaloed(context, outer, look, { colour: look.ink, width: 1.25 });
  context.fillStyle = colour;
  context.fill(dots);
  const grabbed = end === null ? null : entry.ends[end];
  if (grabbed) {
    const handle = new Path2D();
    for (const [dx, dy] of [[-1, 0], [1, 0], [0, -1], [0, 1]]) {
      const [from, to] = [(RING_PX + 1) * look.scale, (RING_PX + 9) * look.scale];
      handle.moveTo(grabbed[0] + dx * from, grabbed[1] + dy * from);
      handle.lineTo(grabbed[0] + dx * to, grabbed[1] + dy * to);
    }
    strokeHaloed(context, handle, look, { colour: look.ink, width: 2 });
  }
  const [hairs, tips] = [new Path2D(), []];
  traceResidual(hairs, tips, viewport, mark.predicted, entry.ends);
  strokeHaloed(context, hairs, look, { colour: look.ink, width: 1, dash: [3, 2] });
  stamp(context, look, tips, { colour: look.ink, halo: look.halo, radius: 2.5, width: 1.25 });
  drawNumber(context, entry, look);
};

/**
 * Draw what is unfinished, or offered: dashed.
 * @param {{ends: (number[] | null)[], line: number[][] | null}} placed in pixels
 * @param {{colour: string, outline?: number, offered?: boolean}} how `outline`: strength of the glow around what waits
 */
export const drawOpen = (context, viewport, { ends, line }, look, { colour, outline = 0, offered = false }) => {
  const [strokes, rings] = [new Path2D(), new Path2D()];
  const places = ends.map((uv) => uv && toScreen(viewport, uv));
  if (line) between(strokes, toScreen(viewport, line[0]), toScreen(viewport, line[1]), places, RING_PX * look.scale);
  for (const at of places) if (at) ring(rings, at, RING_PX * look.scale);
  context.lineCap = "round";
  if (outline > 0) {
    context.globalAlpha = outline;
    context.strokeStyle = look.ink;
    context.lineWidth = 8 * look.scale;
    context.stroke(strokes);
    context.stroke(rings);
    context.globalAlpha = 1;
  }
  strokeHaloed(context, strokes, look, { colour, width: offered ? 1.5 : 2, dash: offered ? [3, 5] : [7, 5] });
  strokeHaloed(context, rings, look, { colour, width: 1.5, dash: offered ? [2, 2] : [] });
  const dots = new Path2D();
  for (const at of places) if (at) ring(dots, at, look.scale);
  context.fillStyle = colour;
  context.fill(dots);
};

/**
 * Draw where a running solver has the matches now: small rings, each tied to what was picked by a hairline.
 * @param {Record<string, (number[] | null)[]>} predicted
 */
export const drawPredictions = (context, viewport, size, marks, predicted, look) => {
  const [hairs, tips] = [new Path2D(), []];
  const sight = sightOf(viewport, size);
  for (const mark of marks) {
    (predicted[mark.id] ?? []).forEach((uv, k) => {
      if (!uv || !mark.ends[k]) return;
      if (!inSight([uv, mark.ends[k]], sight)) return;
      const [at, from] = [toScreen(viewport, uv), toScreen(viewport, mark.ends[k])];
      hairs.moveTo(...from);
      hairs.lineTo(...at);
      tips.push(at);
    });
  }
  context.lineWidth = look.scale;
  context.strokeStyle = "rgba(255, 255, 255, .55)";
  context.stroke(hairs);
  stamp(context, look, tips, { colour: look.ink, halo: look.halo, radius: 3, width: 1.25 });
};
