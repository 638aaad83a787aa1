/**
 * Drawing of matches over a picture. Strokes have the same width at every zoom, on a dark halo, so that they are
 * legible on any picture. There is one path for each style and colour: 500 matches cost a dozen strokes. They are laid
 * out first, so that a change can be drawn alone: see `changedBoxes`.
 */

import { colourOf } from "./colors.js";
import { drawLabels, drawNumber, labelBox, placeLabels, stamp, strokeHaloed } from "./symbols.js";
import { toPixel, toScreen } from "./viewport.js";

/** @typedef {import("./colors.js").Look} Look */

/**
 * @typedef {import("./marks.js").Mark} Mark
 * @typedef {import("./viewport.js").Viewport} Viewport
 * @typedef {CanvasRenderingContext2D} Context
 * @typedef {readonly number[] | null | undefined} Place
 * @typedef {readonly Place[] | null} Places
 */

export const RING_PX = 5;
const POINT_PX = 4;
const MARGIN_PX = 24;
const MIN_SAMPLE_SPACING_PX = 7;
const MIN_RESIDUAL_PX = 3;
const CROSS_PX = 5;
const REACH_PX = 14; // of symbols and strokes around a position
const LABEL_REACH_PX = 5; // of a number around its box
const MAX_CHANGED = 40;
/** @type {Record<Mark["state"], number>} */
const WIDTHS = { enabled: 2, disabled: 1.25, outlier: 4 };
/** @type {Record<Mark["state"], number[]>} */
const DASHES = { enabled: [], disabled: [4, 4], outlier: [] };
const DOTS = { line: 1, point: 1.25 };
const RADII = { line: RING_PX, point: POINT_PX };
const TAU = 2 * Math.PI;

/** @param {Path2D} path @param {readonly number[]} at @param {number} radius */
const ring = (path, [x, y], radius) => {
  path.moveTo(x + radius, y);
  path.arc(x, y, radius, 0, TAU);
};

/** @param {Path2D} path @param {readonly number[]} at @param {number} reach */
const cross = (path, [x, y], reach) => {
  path.moveTo(x - reach, y - reach);
  path.lineTo(x + reach, y + reach);
  path.moveTo(x - reach, y + reach);
  path.lineTo(x + reach, y - reach);
};

/**
 * Trace the line from ring to ring: the pixels inside the rings stay visible.
 * @param {Path2D} path
 * @param {readonly number[]} a
 * @param {readonly number[]} b
 * @param {readonly unknown[]} ringed
 * @param {number} radius
 */
const between = (path, a, b, ringed, radius) => {
  const length = Math.hypot(b[0] - a[0], b[1] - a[1]);
  if (length < 0.5) return;
  /** @param {0 | 1} end */
  const cut = (end) => (ringed[end] && length > 3 * radius ? radius / length : 0);
  /** @param {number} t */
  const at = (t) => [a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1])];
  const [from, to] = [at(cut(0)), at(1 - cut(1))];
  path.moveTo(from[0], from[1]);
  path.lineTo(to[0], to[1]);
};

/**
 * @param {Viewport} viewport
 * @param {readonly number[]} size
 * @returns {number[]} left, top, right, bottom of the visible part, in image pixels
 */
const visibleBox = (viewport, size) => [
  ...toPixel(viewport, [-MARGIN_PX, -MARGIN_PX]),
  ...toPixel(viewport, [size[0] + MARGIN_PX, size[1] + MARGIN_PX]),
];

/**
 * @param {(readonly number[] | null)[]} uvs
 * @param {readonly number[]} box
 * @returns {boolean} whether the bounding box of the pixels is visible in part
 */
const isVisible = (uvs, box) => {
  let [left, right, top, bottom] = [Infinity, -Infinity, Infinity, -Infinity];
  for (const uv of uvs) {
    if (!uv) continue;
    left = Math.min(left, uv[0]);
    right = Math.max(right, uv[0]);
    top = Math.min(top, uv[1]);
    bottom = Math.max(bottom, uv[1]);
  }
  return right >= box[0] && bottom >= box[1] && left <= box[2] && top <= box[3];
};

/** A mark with its positions in the pane, CSS pixels. @param {Mark} mark @param {Viewport} viewport */
const onScreen = (mark, viewport) => ({
  mark,
  ends: mark.ends.map((uv) => uv && toScreen(viewport, uv)),
  line: mark.line && mark.line.map((uv) => toScreen(viewport, uv)),
  predicted: mark.predicted.map((uv) => uv && toScreen(viewport, uv)),
  samples: mark.samples.map(({ uv, has_range }) => ({ at: toScreen(viewport, uv), has_range })),
});

/**
 * Lay out matches and their numbers.
 * @param {Viewport} viewport
 * @param {readonly number[]} size of the pane
 * @param {Mark[]} marks
 * @param {Look} look
 * @returns {LaidOut[]} those that are visible
 *
 * @typedef {ReturnType<typeof onScreen>} OnScreen
 * @typedef {OnScreen & {label: number[] | null}} LaidOut
 */
export const layOut = (viewport, size, marks, look) => {
  const box = visibleBox(viewport, size);
  const shown = marks.filter((mark) => isVisible(mark.line ?? mark.ends, box)).map((mark) => onScreen(mark, viewport));
  const labels = placeLabels(shown, look);
  return shown.map((entry, k) => ({ ...entry, label: labels[k] }));
};

/** @param {LaidOut} laidOut @param {{scale: number}} look @returns {number[]} left, top, right, bottom of all that is drawn of a match */
const boxOf = ({ mark, ends, line, predicted, samples, label }, { scale }) => {
  const box = [Infinity, Infinity, -Infinity, -Infinity];
  /** @param {number} x @param {number} y @param {number} reach */
  const cover = (x, y, reach) => {
    box[0] = Math.min(box[0], x - reach);
    box[1] = Math.min(box[1], y - reach);
    box[2] = Math.max(box[2], x + reach);
    box[3] = Math.max(box[3], y + reach);
  };
  for (const at of [...ends, ...(line ?? []), ...predicted, ...samples.map(({ at }) => at)]) if (at) cover(at[0], at[1], REACH_PX * scale);
  if (label) {
    const [left, top, right, bottom] = labelBox(mark.number, label, scale);
    cover(left, top, LABEL_REACH_PX * scale);
    cover(right, bottom, LABEL_REACH_PX * scale);
  }
  return box;
};

/** @param {Place} a @param {Place} b */
const samePlace = (a, b) => a === b || (a && b && a[0] === b[0] && a[1] === b[1]);
/** @param {Places} a @param {Places} b */
const samePlaces = (a, b) => a === b || (a && b && a.length === b.length && a.every((at, k) => samePlace(at, b[k])));

/** @param {LaidOut} a @param {LaidOut} b */
const looksSame = (a, b) =>
  a.mark.number === b.mark.number && a.mark.kind === b.mark.kind && a.mark.state === b.mark.state &&
  samePlaces(a.ends, b.ends) && samePlaces(a.line, b.line) && samePlaces(a.predicted, b.predicted) &&
  samePlace(a.label, b.label) && a.samples.length === b.samples.length &&
  a.samples.every(({ at, has_range }, k) => has_range === b.samples[k].has_range && samePlace(at, b.samples[k].at));

/**
 * @param {LaidOut[]} before
 * @param {LaidOut[]} now
 * @param {Look} look
 * @returns {number[][] | null} left, top, right, bottom of each place that looks different; null if there are many
 */
export const changedBoxes = (before, now, look) => {
  const gone = new Map(before.map((entry) => [entry.mark.id, entry]));
  const boxes = [];
  for (const entry of now) {
    const other = gone.get(entry.mark.id);
    gone.delete(entry.mark.id);
    if (other && looksSame(other, entry)) continue;
    if (boxes.length > MAX_CHANGED) return null;
    boxes.push(boxOf(entry, look));
    if (other) boxes.push(boxOf(other, look));
  }
  if (gone.size + boxes.length > MAX_CHANGED) return null;
  for (const entry of gone.values()) boxes.push(boxOf(entry, look));
  return boxes;
};

/** @param {readonly number[]} a @param {readonly number[]} b */
const touches = (a, b) => a[0] < b[2] && b[0] < a[2] && a[1] < b[3] && b[1] < a[3];

/** @param {Pick<OnScreen, "ends" | "line">} match @returns {readonly number[] | null} position of an outlier's cross */
const crossPosition = ({ ends, line }) => (line ? [(line[0][0] + line[1][0]) / 2, (line[0][1] + line[1][1]) / 2] : ends[0]);

/** @param {OnScreen} match @param {Look} look @param {Path2D} strokes @param {Path2D} rings @param {Path2D} dots */
const trace = ({ mark, ends, line }, { scale }, strokes, rings, dots) => {
  if (line) between(strokes, line[0], line[1], ends, RING_PX * scale);
  for (const end of ends) {
    if (!end) continue;
    ring(rings, end, RADII[mark.kind] * scale);
    ring(dots, end, DOTS[mark.kind] * scale);
  }
  const at = mark.state === "outlier" ? crossPosition({ ends, line }) : null;
  if (at) cross(rings, at, (CROSS_PX + 1) * scale);
};

/**
 * Draw the samples along a line; those without a range are crossed circles.
 * @param {Context} context
 * @param {LaidOut["samples"]} samples
 * @param {Look} look
 * @param {string} colour
 */
export const drawSamples = (context, samples, look, colour) => {
  if (samples.length < 2) return;
  const places = samples.map(({ at }) => at);
  const [first, last] = [places[0], places[places.length - 1]];
  const apart = Math.hypot(last[0] - first[0], last[1] - first[1]) / (samples.length - 1);
  if (apart < MIN_SAMPLE_SPACING_PX * look.scale) return;
  stamp(context, look, places.filter((_, k) => samples[k].has_range), { colour, halo: look.halo, radius: 1.2, width: 2 });
  stamp(context, look, places.filter((_, k) => !samples[k].has_range), { colour: look.ink, halo: look.halo, radius: 4, width: 1, cross: 2.8 });
};

/** Trace hairlines from the picked to the predicted positions, where they are far enough apart to be seen. */
const traceResidual = (/** @type {Path2D} */ path, /** @type {number[][]} */ tips, /** @type {OnScreen} */ { predicted, ends }) => {
  predicted.forEach((at, k) => {
    const end = ends[k];
    if (!at || !end) return;
    if (Math.hypot(at[0] - end[0], at[1] - end[1]) < MIN_RESIDUAL_PX) return;
    path.moveTo(end[0], end[1]);
    path.lineTo(at[0], at[1]);
    tips.push(at);
  });
};

/** @typedef {{state: Mark["state"], kind: Mark["kind"], colour: string, strokes: Path2D, ends: (readonly number[])[], crosses: (readonly number[])[]}} Bucket matches of one look */

/**
 * Draw matches with their numbers.
 * @param {Context} context in CSS pixels of the pane
 * @param {LaidOut[]} laidOut
 * @param {Look} look
 * @param {{residuals?: boolean, boxes?: number[][] | null}} [options] `residuals`: draw predicted positions, too;
 *   `boxes`: the places outside of which nothing has to be drawn
 */
export const drawMatches = (context, laidOut, look, { residuals = true, boxes = null } = {}) => {
  const shown = boxes ? laidOut.filter((entry) => boxes.some((box) => touches(box, boxOf(entry, look)))) : laidOut;
  /** @type {Map<string, Bucket>} */
  const buckets = new Map();
  for (const entry of shown) {
    const { number, state, kind } = entry.mark;
    const key = `${state} ${kind} ${(number - 1) % look.matches.length}`;
    /** @type {Bucket} */
    const bucket = buckets.get(key) ?? { state, kind, colour: colourOf(look, number), strokes: new Path2D(), ends: [], crosses: [] };
    buckets.set(key, bucket);
    if (entry.line) between(bucket.strokes, entry.line[0], entry.line[1], entry.ends, RING_PX * look.scale);
    bucket.ends.push(...entry.ends.filter((end) => end !== null));
    const at = state === "outlier" ? crossPosition(entry) : null;
    if (at) bucket.crosses.push(at);
  }
  context.lineCap = "round";
  // In an order that does not depend on which of them are drawn: they overlap.
  for (const [, { state, kind, colour, strokes, ends, crosses }] of [...buckets].sort(([a], [b]) => (a < b ? -1 : 1))) {
    context.globalAlpha = state === "disabled" ? 0.75 : 1;
    if (kind === "line") strokeHaloed(context, strokes, look, { colour, width: WIDTHS[state], dash: DASHES[state] });
    if (kind === "line" && state === "outlier") {
      context.lineWidth = 1.75 * look.scale;
      context.strokeStyle = look.halo;
      context.stroke(strokes);
    }
    const symbol = { colour, halo: look.halo, radius: RADII[kind], width: 1.5, dash: state === "disabled" ? [3, 3] : [], dot: DOTS[kind] };
    stamp(context, look, ends, symbol);
    stamp(context, look, crosses, { colour, halo: look.halo, radius: 0, width: 1.5, cross: CROSS_PX + 1 });
  }
  context.globalAlpha = 1;
  for (const { mark, samples } of shown) if (mark.state !== "disabled") drawSamples(context, samples, look, colourOf(look, mark.number));
  if (residuals) {
    const hairs = new Path2D();
    /** @type {number[][]} */
    const tips = [];
    for (const entry of shown) traceResidual(hairs, tips, entry);
    strokeHaloed(context, hairs, look, { colour: look.ink, width: 1 });
    stamp(context, look, tips, { colour: look.ink, halo: look.halo, radius: 2.5, width: 1 });
  }
  drawLabels(context, shown, look);
};

/**
 * Draw one match again, on top of the others: hovered, selected, or being moved.
 * @param {CanvasRenderingContext2D} context
 * @param {Viewport} viewport
 * @param {import("./marks.js").Mark} mark
 * @param {Look} look
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
  drawSamples(context, entry.samples, look, colour);
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
  const hairs = new Path2D();
  /** @type {number[][]} */
  const tips = [];
  traceResidual(hairs, tips, entry);
  strokeHaloed(context, hairs, look, { colour: look.ink, width: 1, dash: [3, 2] });
  stamp(context, look, tips, { colour: look.ink, halo: look.halo, radius: 2.5, width: 1.25 });
  drawNumber(context, entry, look);
};

/**
 * Draw an unfinished side, or a predicted partner, dashed.
 * @param {CanvasRenderingContext2D} context
 * @param {Viewport} viewport
 * @param {{ends: (number[] | null)[], line: number[][] | null}} placed in pixels
 * @param {Look} look
 * @param {{colour: string, outline?: number, offered?: boolean}} how `outline`: opacity of the glow around a side that
 *   waits for its partner
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
 * Draw the positions of the matches under a running solver's pose: small rings, joined to the picks by hairlines.
 * @param {Record<string, (number[] | null)[]>} predicted
 * @param {Context} context
 * @param {Viewport} viewport
 * @param {readonly number[]} size
 * @param {Mark[]} marks
 * @param {Look} look
 */
export const drawPredictions = (context, viewport, size, marks, predicted, look) => {
  const hairs = new Path2D();
  /** @type {number[][]} */
  const tips = [];
  const box = visibleBox(viewport, size);
  for (const mark of marks) {
    (predicted[mark.id] ?? []).forEach((uv, k) => {
      const end = mark.ends[k];
      if (!uv || !end || !isVisible([uv, end], box)) return;
      const [at, from] = [toScreen(viewport, uv), toScreen(viewport, end)];
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
