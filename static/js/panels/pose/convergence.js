/** The live convergence of the simplex: its six parameters (thesis Figure 3.2) and the logarithm of its cost. */

import { stemColour, store } from "../../net/store.js";
import { isRunning } from "../../state/pipeline.js";
import { makeCanvas } from "../../ui/canvas.js";
import { element, setChildren, setText } from "../../ui/dom.js";
import { fixed, short } from "../../ui/numbers.js";
import { decimalsOf, marks } from "./depth_scale.js";
import { jobControls } from "./job_controls.js";

const DASHES = [[], [], [], [5, 3], [5, 3], [5, 3]];
const DEGREES = 180 / Math.PI;

const MOST_STEPS = 1200;
const NAMES = ["Tx", "Ty", "Tz", "α", "β", "γ"];

/** The steps of one run; every second one is dropped when they become too many. */
class SimplexRun {
  steps = [];
  #every = 1;
  #seen = 0;
  #last = null;

  /** @param {{iteration: number, parameters: number[], cost: number}} event */
  add({ iteration, parameters, cost }) {
    if (this.#last && iteration < this.#last.iteration) this.clear();
    this.#last = { iteration, parameters, cost };
    if (this.#seen++ % this.#every === 0) this.steps.push(this.#last);
    if (this.steps.length > MOST_STEPS) {
      this.steps = this.steps.filter((_, index) => index % 2 === 0);
      this.#every *= 2;
    }
  }

  clear() {
    this.steps = [];
    this.#every = 1;
    this.#seen = 0;
    this.#last = null;
  }

  /** @returns {{iteration: number, parameters: number[], cost: number}[]} always ending with the newest */
  get shown() {
    return this.#last && this.steps.at(-1) !== this.#last ? [...this.steps, this.#last] : this.steps;
  }
}

/**
 * Scale six curves to a common axis: each is relative to its last value; lengths and angles have one scale each.
 * @param {{parameters: number[]}[]} steps
 * @returns {{curves: number[][], reach: number[]}} values within [-1, 1]; the size of 1 in m and in rad
 */
const scaledCurves = (steps) => {
  const last = steps.at(-1)?.parameters ?? [0, 0, 0, 0, 0, 0];
  const offsets = NAMES.map((_, index) => steps.map(({ parameters }) => parameters[index] - last[index]));
  const largest = (from) => offsets.slice(from, from + 3).flat().reduce(
    (most, value) => Math.max(most, Math.abs(value)),
    0,
  );
  const reach = [largest(0), largest(3)];
  const curves = offsets.map((curve, index) => curve.map((value) => value / (reach[index < 3 ? 0 : 1] || 1)));
  return { curves, reach };
};

/** @returns {number[]} log10 of the costs; costs that are not positive count as the smallest positive one */
const logCosts = (steps) => {
  const positive = steps.map(({ cost }) => cost).filter((cost) => cost > 0);
  const least = positive.length ? Math.min(...positive) : 1;
  return steps.map(({ cost }) => Math.log10(cost > 0 ? cost : least));
};

const curve = (context, values, x, y) => {
  context.beginPath();
  values.forEach((value, index) => (index ? context.lineTo(x(index), y(value)) : context.moveTo(x(index), y(value))));
  context.stroke();
};

/** @returns {HTMLElement} */
export const mountConvergence = () => {
  const run = new SimplexRun();
  let photo = null;
  const xOf = (steps, left, right) => {
    const [first, last] = [steps[0]?.iteration ?? 0, steps.at(-1)?.iteration ?? 1];
    return (index) => left + ((steps[index].iteration - first) / Math.max(1, last - first)) * (right - left);
  };

  const paintSix = (context, width, height, ink, em) => {
    const steps = run.shown;
    const { curves, reach } = scaledCurves(steps);
    const [left, right, top, bottom] = [em * 0.5, width - em * 1.8, em * 1.4, height - em * 0.4];
    const y = (value) => (top + bottom) / 2 - (value * (bottom - top)) / 2;
    context.strokeStyle = ink("--lr-line");
    curve(context, [0, 0], (index) => [left, right][index], y);
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
  };
  const paintCost = (context, width, height, ink, em) => {
    const steps = run.shown;
    const values = logCosts(steps);
    if (values.length < 2) return;
    const [least, most] = [Math.min(...values), Math.max(...values)];
    const [left, right, top, bottom] = [em * 4.4, width - em * 0.5, em * 0.7, height - em * 0.7];
    const y = (value) => bottom - ((value - least) / (most - least || 1)) * (bottom - top);
    context.fillStyle = ink("--lr-dim");
    context.strokeStyle = ink("--lr-line");
    context.textBaseline = "middle";
    context.textAlign = "right";
    const shown = marks(least, most, 3);
    const decimals = decimalsOf(shown);
    for (const mark of shown) {
      context.fillText(fixed(mark, decimals), left - em * 0.4, y(mark));
      curve(context, [mark, mark], (index) => [left, right][index], y);
    }
    context.strokeStyle = ink("--lr-ink");
    context.lineWidth = 1.4;
    curve(context, values, xOf(steps, left, right), y);
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
  const body = element(
    "div",
    { class: "convergence-body", hidden: true },
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
  store.onEvent("simplex", (event) => {
    if (event.photo !== photo) run.clear();
    photo = event.photo;
    run.add(event);
    body.hidden = false;
    empty.hidden = true;
    event.parameters.forEach(
      (value, index) => setText(values[index], index < 3 ? `${fixed(value, 3)} m` : `${fixed(value * DEGREES, 2)}°`),
    );
    setText(
      state,
      `${event.iteration} · ${event.inliers} of ${event.matches}${event.round ? ` · round ${event.round + 1}` : ""}`,
    );
    draw();
  });
  const show = () => {
    const job = store.get("job");
    const active = job && ["simplex", "reject_outliers", "thesis"].includes(job.kind) && isRunning(job);
    state.classList.toggle("accent", Boolean(active && job.state === "running"));
    if (!run.shown.length) setChildren(state);
  };
  store.watch(["job"], show);
  show();
  return part;
};
