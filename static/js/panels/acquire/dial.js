/** A small dial of the unit's position: pan seen from above, tilt from the side, each with its limits. */

import { element, setText, shape } from "../../ui/dom.js";

const RADIUS = 34;
const CENTRE = 40;

/**
 * @param {number} degrees
 * @param {number} radius
 * @param {boolean} upright
 * @returns {[number, number]} a point on the dial; 0 degrees is up for pan and to the right for tilt
 */
const at = (degrees, radius, upright) => {
  const angle = ((upright ? 90 : 0) + degrees) * (Math.PI / 180);
  return [CENTRE + radius * Math.cos(angle), CENTRE - radius * Math.sin(angle)];
};

/** @param {number} low @param {number} high @param {boolean} upright */
const arc = (low, high, upright) => {
  const [from, to] = [at(low, RADIUS, upright), at(high, RADIUS, upright)];
  return `M${from.join(" ")}A${RADIUS} ${RADIUS} 0 ${high - low > 180 ? 1 : 0} 0 ${to.join(" ")}`;
};

/** @param {string} label @param {boolean} upright */
const makeOne = (label, upright) => {
  const ring = shape("circle", { cx: CENTRE, cy: CENTRE, r: RADIUS, class: "ring" });
  const limits = shape("path", { class: "limits" });
  const hand = shape("line", { x1: CENTRE, y1: CENTRE, class: "hand" });
  const svg = shape("svg", { viewBox: "0 0 80 80", "aria-hidden": "true" });
  svg.append(ring, limits, hand, shape("circle", { cx: CENTRE, cy: CENTRE, r: 2.5, class: "hub" }));
  const value = element("output", { class: "figures" });
  /** @param {number | null} degrees @param {number} low @param {number} high */
  const show = (degrees, low, high) => {
    limits.setAttribute("d", arc(low, high, upright));
    const [x, y] = at(degrees ?? 0, RADIUS - 4, upright);
    hand.setAttribute("x2", String(x));
    hand.setAttribute("y2", String(y));
    setText(value, degrees === null ? "–" : `${degrees.toFixed(2)}°`);
  };
  return { node: element("figure", { class: "dial" }, svg, element("figcaption", {}, element("span", {}, label), value)), show };
};

/**
 * @typedef {import("../../protocol.d.ts").Acquisition} Acquisition
 * @returns {{element: HTMLElement, show: (now: Acquisition) => void}}
 */
export const makeDial = () => {
  const [pan, tilt] = [makeOne("Pan", true), makeOne("Tilt", false)];
  const show = (/** @type {Acquisition} */ { at_deg: here, devices }) => {
    if (!devices) return;
    pan.show(here?.[0] ?? null, devices.lowest_deg[0], devices.highest_deg[0]);
    tilt.show(here?.[1] ?? null, devices.lowest_deg[1], devices.highest_deg[1]);
  };
  return { element: element("div", { class: "dials" }, pan.node, tilt.node), show };
};
