/** The audit of a pose that is used: what the images say of it, and how small an error they would show. */

import { element, shape } from "../../ui/dom.js";
import { icon } from "../../ui/icons.js";

const WIDTH = 260, HEIGHT = 132;
const LEFT = 44, RIGHT = 10, TOP = 10, FOOT = 34;
const MM = 1000, DEGREES = 180 / Math.PI;
/** @type {Record<string, [string, string, string]>} sign, level and words of each outcome */
const OUTCOMES = {
  right: ["tick", "ok", "The pose is right"],
  wrong: ["warn", "bad", "The pose is wrong"],
  undecidable: ["info", "none", "Undecidable: the images verify nothing near it"],
};

/** @param {number} size */
const sizeText = (size) => String(Number(size.toPrecision(2)));

/** @param {number} probability */
const percent = (probability) => `${Math.round(100 * probability)} %`;

/**
 * A power curve: the probability that an error of a size would be found, over a logarithmic axis of sizes, and the same
 * as a table.
 * @param {number[][]} points sizes with their probabilities
 * @param {{factor: number, unit: string, title: string, wanted: number, smallest: number | null}} shown `factor`: from
 *   the points' unit to the one that is shown; `smallest`: size that is found with the probability `wanted`, if it is known
 */
const curve = (points, { factor, unit, title, wanted, smallest }) => {
  const sizes = points.map(([size]) => Math.log(size));
  const [low, high] = [Math.min(...sizes), Math.max(...sizes)];
  const [right, foot] = [WIDTH - RIGHT, HEIGHT - FOOT];
  const x = (/** @type {number} */ size) => LEFT + ((Math.log(size) - low) / (high - low)) * (right - LEFT);
  const y = (/** @type {number} */ probability) => foot - probability * (foot - TOP);
  /** @param {number} at @param {number} up @param {string} words @param {string} anchor @param {string} [turned] */
  const text = (at, up, words, anchor, turned = "") =>
    shape("text", { x: at, y: up, "text-anchor": anchor, ...(turned ? { transform: turned } : {}) }, words);
  const of = (/** @type {number} */ size) => `${sizeText(size * factor)} ${unit}`;
  const inside = smallest !== null && Math.log(smallest) >= low && Math.log(smallest) <= high;
  const [first, middle, last] = [points[0], points[Math.floor(points.length / 2)], points[points.length - 1]];
  const said = smallest === null
    ? `No error of up to ${of(last[0])} would be found nine times in ten.`
    : `${of(smallest)} would be found with a probability of ${percent(wanted)}.`;
  const half = (TOP + foot) / 2;
  return element(
    "figure",
    { class: "power" },
    element("figcaption", {}, title),
    shape(
      "svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img", "aria-label": `${title}. ${said}` },
      ...[0, 0.5, 1].flatMap((level) => [
        shape("path", { class: "grid", d: `M${LEFT} ${y(level)}H${right}` }),
        text(LEFT - 4, y(level) + 3, percent(level), "end"),
      ]),
      shape("path", { class: "axis", d: `M${LEFT} ${TOP}V${foot}H${right}` }),
      inside ? shape("path", { class: "wanted", d: `M${LEFT} ${y(wanted)}H${x(smallest)}V${foot}` }) : "",
      shape("polyline", { class: "curve", points: points.map(([size, p]) => `${x(size).toFixed(1)},${y(p).toFixed(1)}`).join(" ") }),
      ...points.map(([size, p]) => shape("circle", { class: "point", cx: x(size).toFixed(1), cy: y(p).toFixed(1), r: 2 })),
      ...[first, middle, last].map(([size], k) => text(x(size), foot + 13, sizeText(size * factor), ["start", "middle", "end"][k])),
      text((LEFT + right) / 2, HEIGHT - 5, `size of the error, ${unit}`, "middle"),
      text(10, half, "found", "middle", `rotate(-90 10 ${half})`),
    ),
    element("p", { class: "dim" }, said),
    element(
      "details",
      {},
      element("summary", { class: "dim" }, "As a table"),
      element(
        "table",
        { class: "power-table figures" },
        element("thead", {}, element("tr", {}, element("th", { scope: "col" }, "Error"), element("th", { scope: "col" }, "Found"))),
        element("tbody", {}, ...points.map(([size, p]) => element("tr", {}, element("td", {}, of(size)), element("td", {}, percent(p))))),
      ),
    ),
  );
};

/**
 * @param {import("../../protocol.d.ts").Audit} found slice `audit:pID`
 * @returns {HTMLElement}
 */
export const auditReport = (found) => {
  const [sign, level, words] = OUTCOMES[found.outcome];
  const { rotation_rad, position_m, seen_with_probability: wanted, smallest_rotation_rad, smallest_position_m } = found.power;
  return element(
    "section",
    { class: "audit", "aria-label": "Audit" },
    element("h3", {}, `Audit of ${found.judged}`),
    element("p", { class: `audit-outcome ${level}` }, icon(sign), ` ${words}`),
    element("p", {}, found.sentence),
    position_m.length ? element(
      "div",
      { class: "powers" },
      curve(position_m, { factor: MM, unit: "mm", title: "Shifts that would be found", wanted, smallest: smallest_position_m }),
      curve(rotation_rad, { factor: DEGREES, unit: "deg", title: "Turns that would be found", wanted, smallest: smallest_rotation_rad }),
    ) : null,
  );
};
