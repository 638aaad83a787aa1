/** The live convergence of the simplex: its six parameters (thesis Figure 3.2) and the logarithm of its cost. */

import { stemColour, store } from "../../net/store.js";
import { runningJob } from "../../state/pipeline.js";
import { simplexRun } from "../../state/simplex_run.js";
import { makeCanvas } from "../../ui/canvas.js";
import { button } from "../../ui/controls.js";
import { element, setChildren, setText } from "../../ui/dom.js";
import { icon } from "../../ui/icons.js";
import { fixed, short } from "../../ui/numbers.js";
import { decimalsOf, marks } from "./depth_scale.js";
import { jobControls } from "./job_controls.js";

/**
 * @typedef {import("../../state/simplex_run.js").Frame} Frame
 * @typedef {import("../../ui/canvas.js").Paint} Paint
 * @typedef {(index: number) => number} AtStep a place on the horizontal axis
 */

const DASHES = [[], [], [], [5, 3], [5, 3], [5, 3]];
const DEGREES = 180 / Math.PI;

const NAMES = ["Tx", "Ty", "Tz", "α", "β", "γ"];
const MOVING = ["simplex", "reject_outliers", "thesis"];
const SPEEDS = [5, 20, 60, 240];

/**
 * Scale six curves to a common axis: each is relative to its last value; lengths and angles have one scale each.
 * @param {{parameters: number[]}[]} steps
 * @returns {{curves: number[][], reach: number[]}} values within [-1, 1]; the size of 1 in m and in rad
 */
const scaledCurves = (steps) => {
  const last = steps.at(-1)?.parameters ?? [0, 0, 0, 0, 0, 0];
  const offsets = NAMES.map((_, index) => steps.map(({ parameters }) => parameters[index] - last[index]));
  const largest = (/** @type {number} */ from) => offsets.slice(from, from + 3).flat().reduce(
    (most, value) => Math.max(most, Math.abs(value)),
    0,
  );
  const reach = [largest(0), largest(3)];
  const curves = offsets.map((curve, index) => curve.map((value) => value / (reach[index < 3 ? 0 : 1] || 1)));
  return { curves, reach };
};

/**
 * @param {Frame[]} steps
 * @returns {number[]} log10 of the costs; costs that are not positive count as the smallest positive one
 */
const logCosts = (steps) => {
  const positive = steps.map(({ cost }) => cost).filter((cost) => cost > 0);
  const least = positive.length ? Math.min(...positive) : 1;
  return steps.map(({ cost }) => Math.log10(cost > 0 ? cost : least));
};

/**
 * @param {CanvasRenderingContext2D} context
 * @param {number[]} values
 * @param {AtStep} x
 * @param {(value: number) => number} y
 */
const curve = (context, values, x, y) => {
  context.beginPath();
  values.forEach((value, index) => (index ? context.lineTo(x(index), y(value)) : context.moveTo(x(index), y(value))));
  context.stroke();
};

/** @returns {HTMLElement} */
export const mountConvergence = () => {
  /** @param {Frame[]} steps @param {number} left @param {number} right @returns {AtStep} */
  const xOf = (steps, left, right) => {
    const [first, last] = [steps[0]?.iteration ?? 0, steps.at(-1)?.iteration ?? 1];
    return (/** @type {number} */ index) => left + ((steps[index].iteration - first) / Math.max(1, last - first)) * (right - left);
  };

  /** @type {Paint} */
  const paintSix = (context, width, height, ink, em) => {
    const steps = simplexRun.frames;
    const { curves, reach } = scaledCurves(steps);
    const [left, right, top, bottom] = [em * 0.5, width - em * 1.8, em * 1.4, height - em * 0.4];
    const y = (/** @type {number} */ value) => (top + bottom) / 2 - (value * (bottom - top)) / 2;
    context.strokeStyle = ink("--lr-line");
    curve(context, [0, 0], (index) => (index ? right : left), y);
    context.fillStyle = ink("--lr-dim");
    context.textBaseline = "top";
    context.fillText(
      steps.length > 1 ? `± ${short(reach[0])} m, dashed ± ${short(reach[1] * DEGREES)}°, relative to the last` : "",
      left,
      0,
    );
    if (steps.length < 2) return;
    const x = xOf(steps, left, right);
    context.lineWidth = 1.4;
    context.textBaseline = "middle";
    curves.forEach((values, index) => {
      context.strokeStyle = ink(stemColour(index + 1));
      context.setLineDash(DASHES[index]);
      curve(context, values, x, y);
    });
    context.setLineDash([]);
    paintCursor(context, steps, x, top, bottom, ink);
  };
  /**
   * Where the replay is.
   * @param {CanvasRenderingContext2D} context
   * @param {Frame[]} steps
   * @param {AtStep} x
   * @param {number} top
   * @param {number} bottom
   * @param {(name: string) => string} ink
   */
  const paintCursor = (context, steps, x, top, bottom, ink) => {
    const at = steps.findIndex((step) => step === simplexRun.current);
    if (at < 0) return;
    context.strokeStyle = ink("--lr-accent");
    context.lineWidth = 1;
    context.beginPath();
    context.moveTo(x(at), top);
    context.lineTo(x(at), bottom);
    context.stroke();
  };
  /** @type {Paint} */
  const paintCost = (context, width, height, ink, em) => {
    const steps = simplexRun.frames;
    const values = logCosts(steps);
    if (values.length < 2) return;
    const [least, most] = [Math.min(...values), Math.max(...values)];
    const [left, right, top, bottom] = [em * 4.4, width - em * 0.5, em * 0.7, height - em * 0.7];
    const y = (/** @type {number} */ value) => bottom - ((value - least) / (most - least || 1)) * (bottom - top);
    context.fillStyle = ink("--lr-dim");
    context.strokeStyle = ink("--lr-line");
    context.textBaseline = "middle";
    context.textAlign = "right";
    const shown = marks(least, most, 3);
    const decimals = decimalsOf(shown);
    for (const mark of shown) {
      context.fillText(fixed(mark, decimals), left - em * 0.4, y(mark));
      curve(context, [mark, mark], (index) => (index ? right : left), y);
    }
    context.strokeStyle = ink("--lr-ink");
    context.lineWidth = 1.4;
    curve(context, values, xOf(steps, left, right), y);
    paintCursor(context, steps, xOf(steps, left, right), top, bottom, ink);
  };

  const six = makeCanvas(
    { class: "curve-six", role: "img", "aria-label": "The six parameters over the iterations" },
    paintSix,
  );
  const cost = makeCanvas(
    { class: "curve-cost", role: "img", "aria-label": "Logarithm of the cost over the iterations" },
    paintCost,
  );
  const legend = element("div", { class: "curve-legend" });
  const values = NAMES.map((name, index) => {
    const value = element("span", { class: "figures" });
    const swatch = element("span", { class: `swatch dash-${index < 3 ? "no" : "yes"}`, "aria-hidden": "true" });
    swatch.style.setProperty("--colour", `var(${stemColour(index + 1)})`);
    legend.append(element("span", { class: "curve-name" }, swatch, name, " ", value));
    return value;
  });
  const state = element("span", { class: "curve-state figures" });
  const controls = jobControls({ kinds: ["simplex", "reject_outliers"] });
  const empty = element(
    "p",
    { class: "empty" },
    "While the simplex runs, its six parameters and the logarithm of its cost are plotted here.",
  );
  const isBusy = () => MOVING.includes(runningJob(store.get("job"))?.kind ?? "");
  const play = button({
    label: "Replay",
    icon: "play",
    kind: "small",
    title: "Watch the photograph slide over the model and the pictures once more",
    act: () => (simplexRun.playing ? simplexRun.hold() : simplexRun.play()),
  });
  const slider = element("input", {
    type: "range", min: "0", max: "1", value: "0", "aria-label": "Iteration", title: "Show one iteration",
    on: { input: () => simplexRun.seek(Number(slider.value)) },
  });
  const speed = element(
    "select",
    { class: "select small", "aria-label": "Speed of the replay", on: { change: () => simplexRun.pace(Number(speed.value)) } },
    ...SPEEDS.map((each) => element("option", { value: each }, `${each} per second`)),
  );
  speed.value = String(simplexRun.speed);
  const leave = button({
    label: "End the replay",
    icon: "close",
    bare: true,
    kind: "plain small",
    title: "Show the pose that was found again",
    act: () => simplexRun.leave(),
  });
  const replay = element("div", { class: "curve-replay", role: "group", "aria-label": "Replay" }, play, slider, speed, leave);
  const body = element(
    "div",
    { class: "convergence-body", hidden: true },
    replay,
    six.canvas,
    legend,
    element("p", { class: "dim curve-title" }, "log₁₀ cost"),
    cost.canvas,
  );
  const part = element(
    "section",
    { class: "dock-part convergence-part", "aria-label": "Convergence of the simplex" },
    element(
      "div",
      { class: "part-head" },
      element("h2", {}, "Simplex"),
      state,
      element("div", { class: "end" }, controls),
    ),
    body,
    empty,
  );

  const draw = () => (six.draw(), cost.draw());
  const showFrame = () => {
    const { frames, newest } = simplexRun;
    const frame = simplexRun.current ?? newest;
    body.hidden = !frame;
    empty.hidden = Boolean(frame);
    if (!frame) {
      setText(state, "");
      return;
    }
    frame.parameters.forEach(
      (value, index) => setText(values[index], index < 3 ? `${fixed(value, 3)} m` : `${fixed(value * DEGREES, 2)}°`),
    );
    setText(
      state,
      [
        `iteration ${frame.iteration}`,
        `${frame.inliers} of ${frame.matches} matches agree`,
        frame.round ? `outlier removal ${frame.round}` : "",
      ].filter(Boolean).join(" · "),
    );
    const { playing } = simplexRun;
    if (play.dataset.playing !== String(playing)) setChildren(play, icon(playing ? "pause" : "play"), element("span", {}, playing ? "Pause" : "Replay"));
    play.dataset.playing = String(playing);
    const at = frames.indexOf(frame);
    slider.max = String(Math.max(1, frames.length - 1));
    slider.value = String(at < 0 ? frames.length - 1 : at);
    slider.setAttribute("aria-valuetext", `iteration ${frame.iteration}`);
    replay.hidden = frames.length < 2 || isBusy();
    draw();
  };
  simplexRun.onChange(showFrame);
  const show = () => {
    const job = store.get("job");
    state.classList.toggle("accent", isBusy() && job?.state === "running");
    showFrame();
  };
  store.watch(["job"], show);
  show();
  return part;
};
