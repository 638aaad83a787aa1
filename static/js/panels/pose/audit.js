/** The audit of a pose that is used: what the images say of it, and how small an error they would show. */

import { element, shape } from "../../ui/dom.js";
import { icon } from "../../ui/icons.js";

const WIDTH = 220, HEIGHT = 84;
const LEFT = 30, RIGHT = 8, TOP = 8, FOOT = 20;
const MM = 1000, DEGREES = 180 / Math.PI;
/** @type {Record<string, [string, string, string]>} sign, level and words of each outcome */
const OUTCOMES = {
  right: ["tick", "ok", "The pose is right"],
  wrong: ["warn", "bad", "The pose is wrong"],
  undecidable: ["info", "none", "Undecidable: the images verify nothing near it"],
};

const sizeText = (size) => String(Number(size.toPrecision(2)));

/**
 * A power curve: the probability of seeing an error of a size, over a logarithmic axis of sizes.
 * @param {[number, number][]} points
 * @param {number} factor from the points' unit to the one that is shown
 */
const curve = (points, factor, unit, title, wanted) => {
  const sizes = points.map(([size]) => Math.log(size));
  const [low, high] = [Math.min(...sizes), Math.max(...sizes)];
  const x = (size) => LEFT + ((Math.log(size) - low) / (high - low)) * (WIDTH - LEFT - RIGHT);
  const y = (probability) => TOP + (1 - probability) * (HEIGHT - TOP - FOOT);
  const line = points.map(([size, probability]) => `${x(size).toFixed(1)},${y(probability).toFixed(1)}`).join(" ");
  const label = (at, text, anchor, up) => shape("text", { x: at, y: up, "text-anchor": anchor }, text);
  const said = points.map(([size, probability]) => `${sizeText(size * factor)} ${unit}: ${Math.round(100 * probability)} %`).join(", ");
  const [first, middle, last] = [points[0], points[Math.floor(points.length / 2)], points.at(-1)];
  return element(
    "figure",
    { class: "power" },
    shape(
      "svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img", "aria-label": `${title}: ${said}` },
      shape("path", { class: "axis", d: `M${LEFT} ${TOP}V${HEIGHT - FOOT}H${WIDTH - RIGHT}` }),
      shape("path", { class: "wanted", d: `M${LEFT} ${y(wanted)}H${WIDTH - RIGHT}` }),
      shape("polyline", { class: "curve", points: line }),
      label(LEFT - 4, `${Math.round(100 * wanted)} %`, "end", y(wanted) + 3),
      label(LEFT - 4, "0", "end", y(0) + 3),
      ...[first, middle, last].map(([size], k) => label(x(size), sizeText(size * factor), ["start", "middle", "end"][k], HEIGHT - 6)),
    ),
    element("figcaption", { class: "dim" }, `${title}, ${unit}`),
  );
};

/**
 * @param {any} found slice `audit:pID`
 * @returns {HTMLElement}
 */
export const auditReport = (found) => {
  const [sign, level, words] = OUTCOMES[found.outcome];
  const { rotation_rad, position_m, seen_with_probability } = found.power;
  return element(
    "section",
    { class: "audit", "aria-label": "Audit" },
    element("h3", {}, `Audit of ${found.judged}`),
    element("p", { class: `audit-outcome ${level}` }, icon(sign), ` ${words}`),
    element("p", {}, found.sentence),
    position_m.length ? element(
      "div",
      { class: "powers" },
      curve(position_m, MM, "mm", "Shifts that would be seen", seen_with_probability),
      curve(rotation_rad, DEGREES, "deg", "Turns that would be seen", seen_with_probability),
    ) : null,
  );
};
