/** The live simplex: six parameters about where they are now (thesis Figure 3.2), and the logarithm of the cost. */

import { makeCanvas } from "../ui/canvas.js";
import { runs } from "../state/pipeline.js";
import { logCosts, NAMES, scaledCurves, Walk } from "./convergence_data.js";
import { decimalsOf, marks } from "./depth_scale.js";
import { element, put, say } from "../ui/dom.js";
import { jobControls } from "./job_controls.js";
import { fixed, short } from "../ui/numbers.js";
import { stemColour, store } from "../net/store.js";

const DASHES = [[], [], [], [5, 3], [5, 3], [5, 3]];
const DEGREES = 180 / Math.PI;

const curve = (context, values, x, y) => {
  context.beginPath();
  values.forEach((value, index) => (index ? context.lineTo(x(index), y(value)) : context.moveTo(x(index), y(value))));
  context.stroke();
};

/** @returns {HTMLElement} */
export const mountCurves = () => {
  const walk = new Walk();
  let photo = null;
  const xOf = (steps, left, right) => {
    const [first, last] = [steps[0]?.iteration ?? 0, steps.at(-1)?.iteration ?? 1];
    return (index) => left + ((steps[index].iteration - first) / Math.max(1, last - first)) * (right - left);
  };

  const paintSix = (context, width, height, ink, em) => {
    const steps = walk.shown;
    const { curves, reach } = scaledCurves(steps);
    const [left, right, top, bottom] = [em * 0.5, width - em * 1.8, em * 1.4, height - em * 0.4];
    const y = (value) => (top + bottom) / 2 - (value * (bottom - top)) / 2;
    context.strokeStyle = ink("--lr-line");
    curve(context, [0, 0], (index) => [left, right][index], y);
    context.fillStyle = ink("--lr-dim");
    context.textBaseline = "top";
    context.fillText(
      steps.length > 1 ? `± ${short(reach[0])} m, dashed ± ${short(reach[1] * DEGREES)}°, about the last` : "",
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
    const steps = walk.shown;
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
    "While the simplex walks, its six parameters and the logarithm of its cost are drawn here.",
  );
  const body = element(
    "div",
    { class: "curves-body", hidden: true },
    six.canvas,
    legend,
    element("p", { class: "dim curve-title" }, "log₁₀ cost"),
    cost.canvas,
  );
  const part = element(
    "section",
    { class: "dock-part curves-part", "aria-label": "Live simplex" },
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
    if (event.photo !== photo) walk.clear();
    photo = event.photo;
    walk.take(event);
    body.hidden = false;
    empty.hidden = true;
    event.parameters.forEach(
      (value, index) => say(values[index], index < 3 ? `${fixed(value, 3)} m` : `${fixed(value * DEGREES, 2)}°`),
    );
    say(
      state,
      `${event.iteration} · ${event.inliers} of ${event.matches}${event.round ? ` · round ${event.round + 1}` : ""}`,
    );
    draw();
  });
  const show = () => {
    const job = store.get("job");
    const walks = job && ["simplex", "reject_outliers", "thesis"].includes(job.kind) && runs(job);
    state.classList.toggle("accent", Boolean(walks && job.state === "running"));
    if (!walk.shown.length) put(state);
  };
  store.watch(["job"], show);
  show();
  return part;
};
