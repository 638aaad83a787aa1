/** The depth-error plot (thesis Figures 3.3, 3.4): a stem for each match, a draggable threshold, and a histogram. */

import { requestForPhoto } from "../../net/requests.js";
import { stemColour, store } from "../../net/store.js";
import { view } from "../../state/view.js";
import { makeCanvas } from "../../ui/canvas.js";
import { button } from "../../ui/controls.js";
import { element, partOf, setAttribute, setText } from "../../ui/dom.js";
import { counted, fixed, short } from "../../ui/numbers.js";
import {
  decimalsOf,
  histogram,
  marks,
  reach,
  rejection,
  rounded,
  stemsOf,
  stepped,
} from "./depth_scale.js";
import { rowsOf } from "../matches/match_rows.js";

/** @typedef {import("./depth_scale.js").Stem} Stem @typedef {import("../../ui/canvas.js").Paint} Paint */

const BINS = 31;
const GRIP_PX = 7;
const FEW = 40; // up to this number each stem has the colour of its match
/** @type {Record<string, boolean>} keys that move the threshold */
const UPWARDS = { ArrowUp: true, ArrowRight: true, ArrowDown: false, ArrowLeft: false };
const UNITS = { depth: "m", px: "px" };

/** @returns {HTMLElement} */
export const mountDepthPlot = () => {
  /** @type {Stem[]} */
  let stems = [];
  /** @type {Stem[]} */
  let shown = [];
  let inliersOnly = false;
  /** @type {string | null} */
  let hovering = null;
  let dragging = false;

  const by = () => view.get().threshold.by;
  /** @returns {number | null} */
  const chosen = () => view.get().threshold.above[by()] ?? store.judgedOf()?.thresholds?.[by()] ?? null;
  /** The threshold, with both signs if errors are signed. */
  const thresholds = () => {
    const above = chosen();
    if (above === null) return [];
    return by() === "depth" ? [above, -above] : [above];
  };
  const setAbove = (/** @type {number} */ value) => {
    if (!(value > 0)) return;
    const { threshold } = view.get();
    view.set({ threshold: { ...threshold, above: { ...threshold.above, [threshold.by]: value } } });
  };

  /** @param {number} height @param {number} em */
  const scale = (height, em) => {
    const most = reach(shown, chosen());
    const signed = by() === "depth";
    const [top, bottom] = [em * 0.8, height - em * 0.8];
    const least = signed ? -most : 0;
    return {
      most,
      least,
      top,
      bottom,
      y: (/** @type {number} */ value) => bottom - ((value - least) / (most - least)) * (bottom - top),
      at: (/** @type {number} */ y) => least + ((bottom - y) / (bottom - top)) * (most - least),
    };
  };
  const left = (/** @type {number} */ em) => em * 4.2;
  /** @param {number} width @param {number} em */
  const room = (width, em) => width - left(em) - em * 0.5;
  /** @param {number} index @param {number} width @param {number} em */
  const xOf = (index, width, em) => left(em) + ((index + 0.5) / Math.max(1, shown.length)) * room(width, em);

  /** @type {Paint} */
  const paint = (context, width, height, ink, em) => {
    const { y, most, least } = scale(height, em);
    const above = chosen();
    const { above: outliers } = rejection(stems, above);
    const x0 = left(em);
    context.textBaseline = "middle";
    context.textAlign = "right";
    const shownMarks = marks(least, most, height / (em * 2.2));
    const decimals = decimalsOf(shownMarks);
    for (const mark of shownMarks) {
      context.strokeStyle = ink("--lr-line");
      context.globalAlpha = mark === 0 ? 1 : 0.5;
      line(context, x0, y(mark), width, y(mark));
      context.globalAlpha = 1;
      context.fillStyle = ink("--lr-dim");
      context.fillText(fixed(mark, mark === 0 ? 0 : decimals), x0 - em * 0.5, y(mark));
    }
    const few = shown.length <= FEW;
    const dot = Math.max(1.6, Math.min(3.2, (width - x0) / Math.max(1, shown.length) / 2.2));
    const { hovered, selected } = view.get();
    shown.forEach((stem, index) => {
      const x = xOf(index, width, em);
      const off = !stem.on || outliers.has(stem.id);
      const clipped = Math.max(least, Math.min(most, stem.value));
      const lit = stem.id === hovered || selected.has(stem.id);
      context.globalAlpha = off && !lit ? 0.6 : 1;
      const own = few ? stemColour(stem.number) : "--lr-accent";
      context.strokeStyle = context.fillStyle = ink(lit ? "--lr-ink" : off ? "--lr-dim" : own);
      context.lineWidth = lit ? 2 : few ? 1.6 : 1;
      line(context, x, y(0), x, y(clipped));
      if (clipped !== stem.value) arrow(context, x, y(clipped), Math.sign(stem.value), dot + 1);
      else if (off) ring(context, x, y(clipped), dot);
      else disc(context, x, y(clipped), dot);
      if (lit && few) context.fillText(
        String(stem.number),
        x + em * 0.9,
        y(clipped) - Math.sign(stem.value || 1) * em * 0.8,
      );
    });
    context.globalAlpha = 1;
    context.lineWidth = 1;
    for (const value of thresholds()) threshold(context, ink, x0, width, y(value));
  };

  /** @type {Paint} */
  const paintHistogram = (context, width, height, ink, em) => {
    const { y, most, least } = scale(height, em);
    const bins = histogram(shown, least, most, BINS);
    const tallest = Math.max(1, ...bins.on.map((count, index) => count + bins.off[index]));
    const depth = Math.abs(y(least) - y(most)) / BINS;
    const above = chosen();
    for (let index = 0; index < BINS; index += 1) {
      const top = y(least + ((index + 1) / BINS) * (most - least)) + 0.5;
      const middle = least + ((index + 0.5) / BINS) * (most - least);
      const beyond = above !== null && Math.abs(middle) > above;
      const enabled = (bins.on[index] / tallest) * (width - 4);
      const disabled = (bins.off[index] / tallest) * (width - 4);
      context.fillStyle = ink(beyond ? "--lr-dim" : "--lr-accent");
      context.globalAlpha = beyond ? 0.6 : 1;
      context.fillRect(0, top, enabled, Math.max(1, depth - 1));
      context.fillStyle = ink("--lr-dim");
      context.globalAlpha = 0.4;
      context.fillRect(enabled, top, disabled, Math.max(1, depth - 1));
    }
    context.globalAlpha = 1;
    context.strokeStyle = ink("--lr-line");
    line(context, 0.5, y(most), 0.5, y(least));
    for (const value of thresholds()) threshold(context, ink, 0, width, y(value));
  };

  const plot = makeCanvas(
    {
      class: "depth-canvas",
      role: "slider",
      tabIndex: 0,
      "aria-orientation": "vertical",
      "aria-label": "Threshold of the depth errors",
      "aria-valuemin": 0,
    },
    paint,
  );
  const bars = makeCanvas(
    { class: "depth-bars", role: "img", "aria-label": "Histogram of the errors" },
    paintHistogram,
  );
  const { canvas } = plot;
  const redraw = () => (plot.draw(), bars.draw());

  const unit = element(
    "select",
    {
      class: "select small",
      "aria-label": "Unit of the errors",
      on: { change: () => view.set({ threshold: { ...view.get().threshold, by: unit.value === "px" ? "px" : "depth" } }) },
    },
    element("option", { value: "depth" }, "depth, m"),
    element("option", { value: "px" }, "pixels"),
  );
  const field = element(
    "input",
    { class: "number short", type: "number", min: "0", step: "any", "aria-label": "Disable above" },
  );
  field.addEventListener("change", () => (field.valueAsNumber > 0 ? setAbove(field.valueAsNumber) : read()));
  const unitLabel = element("span", { class: "dim" });
  const status = element("span", { class: "visually-hidden", role: "status" });
  const apply = button({
    label: "Disable",
    kind: "small warn-button edits",
    act: () => {
      const above = chosen();
      if (above !== null) requestForPhoto("reject", { by: by(), above });
    },
  });
  const inliersToggle = button({
    label: "Inliers only",
    kind: "small toggle",
    title: "Show only the matches below the threshold, on their own scale",
    act: () => ((inliersOnly = !inliersOnly), read()),
  });
  const empty = element("p", { class: "empty" }, "The errors of the matches are plotted here once there is a pose.");
  const body = element("div", { class: "depth-body" }, canvas, bars.canvas);
  const part = element(
    "section",
    { class: "dock-part depth", "aria-label": "Depth error" },
    element(
      "div",
      { class: "part-head" },
      element("h2", {}, "Depth error"),
      unit,
      inliersToggle,
      element(
        "div",
        { class: "end" },
        element(
          "label",
          { class: "inline" },
          "above",
          field,
          unitLabel,
        ),
        apply,
        status,
      ),
    ),
    body,
    empty,
  );

  const read = () => {
    const { threshold } = view.get();
    stems = stemsOf(rowsOf(store.picksOf(), store.judgedOf()), threshold.by);
    const above = chosen();
    const { above: outliers, off, on } = rejection(stems, above);
    shown = inliersOnly ? stems.filter((stem) => stem.on && !outliers.has(stem.id)) : stems;
    empty.hidden = stems.length > 0;
    body.hidden = stems.length === 0;
    unit.value = threshold.by;
    setText(unitLabel, UNITS[threshold.by]);
    if (document.activeElement !== field) field.value = above === null ? "" : String(rounded3(above));
    field.disabled = above === null;
    inliersToggle.setAttribute("aria-pressed", String(inliersOnly));
    const nothing = off === 0 && on === 0;
    setText(status, above === null ? "" : `${counted(outliers.size, "match", "matches")} above`);
    apply.disabled = nothing || above === null;
    setText(
      partOf(apply, "span"),
      off > 0 ? `Disable ${off}` : on > 0 ? `Re-enable ${on}` : outliers.size > 0 ? `${outliers.size} disabled` : "Disable none",
    );
    apply.title = nothing ? "No match would change" : [
      off ? `Disables ${counted(off, "match", "matches")} above the threshold` : "",
      on ? `${off ? "re-enables" : "Re-enables"} ${on} below it` : "",
    ].filter(Boolean).join(", ");
    setAttribute(canvas, "aria-valuenow", above);
    setAttribute(canvas, "aria-valuemax", rounded(reach(shown, above)));
    setAttribute(
      canvas,
      "aria-valuetext",
      above === null ? "no errors yet" : `${short(above)} ${UNITS[threshold.by]}, ${outliers.size} matches above`,
    );
    redraw();
  };
  const rounded3 = (/** @type {number} */ value) => Number(value.toPrecision(3));

  const em = () => Number.parseFloat(getComputedStyle(canvas).fontSize);
  const local = (/** @type {MouseEvent} */ event) => {
    const box = canvas.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  };
  const overThreshold = (/** @type {number} */ y) => {
    const of = scale(canvas.clientHeight, em());
    return thresholds().some((value) => Math.abs(of.y(value) - y) < GRIP_PX);
  };
  const stemAt = (/** @type {number} */ x) => {
    const index = Math.floor(((x - left(em())) / room(canvas.clientWidth, em())) * shown.length);
    return shown[index] ?? null;
  };
  canvas.addEventListener("pointerdown", (event) => {
    const [x, y] = local(event);
    if (overThreshold(y)) {
      dragging = true;
      canvas.setPointerCapture(event.pointerId);
    } else {
      const stem = stemAt(x);
      if (stem) view.set({ selected: new Set([stem.id]), end: null, offer: stem.id });
    }
  });
  canvas.addEventListener("pointermove", (event) => {
    const [x, y] = local(event);
    if (dragging) return setAbove(rounded3(Math.abs(scale(canvas.clientHeight, em()).at(y))));
    canvas.classList.toggle("grip", overThreshold(y));
    const stem = overThreshold(y) ? null : stemAt(x);
    if ((stem?.id ?? null) !== hovering) view.set({ hovered: (hovering = stem?.id ?? null) });
    canvas.title = stem
      ? `Match ${stem.number}: ${fixed(stem.value, 3)} ${UNITS[by()]}`
      : "Drag the dashed line, or use the arrow keys";
    return undefined;
  });
  canvas.addEventListener("lostpointercapture", () => {
    dragging = false;
  });
  canvas.addEventListener("pointerleave", () => hovering && view.set({ hovered: (hovering = null) }));
  canvas.addEventListener("keydown", (event) => {
    const up = UPWARDS[event.key];
    const above = chosen();
    if (up === undefined || above === null) return;
    event.preventDefault();
    event.stopPropagation();
    setAbove(stepped(above, up, event.shiftKey));
  });
  field.addEventListener("keydown", (event) => {
    const up = event.key === "ArrowUp";
    const above = chosen();
    if ((!up && event.key !== "ArrowDown") || above === null) return;
    event.preventDefault();
    const next = stepped(above, up, event.shiftKey);
    field.value = String(next);
    setAbove(next);
  });

  store.watch(["picks:*", "judged:*", "shown"], read);
  view.on((_, changed) => {
    if (changed.has("threshold")) read();
    else if (changed.has("hovered") || changed.has("selected")) redraw();
  });
  read();
  return part;
};

/**
 * @param {CanvasRenderingContext2D} context
 * @param {number} x0
 * @param {number} y0
 * @param {number} x1
 * @param {number} y1
 */
const line = (context, x0, y0, x1, y1) => {
  context.beginPath();
  context.moveTo(x0, y0);
  context.lineTo(x1, y1);
  context.stroke();
};
/** @param {CanvasRenderingContext2D} context @param {number} x @param {number} y @param {number} radius */
const disc = (context, x, y, radius) => {
  context.beginPath();
  context.arc(x, y, radius, 0, 2 * Math.PI);
  context.fill();
};
/** @param {CanvasRenderingContext2D} context @param {number} x @param {number} y @param {number} radius */
const ring = (context, x, y, radius) => {
  context.beginPath();
  context.arc(x, y, radius, 0, 2 * Math.PI);
  context.stroke();
};
/**
 * An arrow for an error beyond the axis.
 * @param {CanvasRenderingContext2D} context
 * @param {number} x
 * @param {number} y
 * @param {number} sign
 * @param {number} size
 */
const arrow = (context, x, y, sign, size) => {
  context.beginPath();
  context.moveTo(x - size, y + sign * size);
  context.lineTo(x, y - sign * size);
  context.lineTo(x + size, y + sign * size);
  context.fill();
};
/**
 * @param {CanvasRenderingContext2D} context
 * @param {(name: string) => string} ink
 * @param {number} x0
 * @param {number} x1
 * @param {number} y
 */
const threshold = (context, ink, x0, x1, y) => {
  context.save();
  context.strokeStyle = ink("--lr-warn");
  context.setLineDash([5, 4]);
  line(context, x0, y, x1, y);
  context.restore();
  context.fillStyle = ink("--lr-warn");
  context.fillRect(x1 - 12, y - 4, 12, 8);
};
