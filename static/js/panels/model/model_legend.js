/** The legend of the texture that is drawn, over the 3-D view. */

import { element, setChildren } from "../../ui/dom.js";

/**
 * @typedef {{title: string, ramp: string[], least: string, most: string, entries: {colour: string, label: string}[]}} Legend
 *   of a texture, as the workbench sends it
 */

const KEY = "ladarreg-model-legend";

const remembered = () => {
  try {
    return localStorage.getItem(KEY) !== "hidden";
  } catch {
    return true; // storage is disabled
  }
};

/** @param {boolean} visible */
const remember = (visible) => {
  try {
    localStorage.setItem(KEY, visible ? "shown" : "hidden");
  } catch {
    // storage is disabled: the choice holds for this visit
  }
};

/** @param {string} colour */
const swatch = (colour) => {
  const box = element("i", { class: "legend-swatch", "aria-hidden": "true" });
  box.style.setProperty("background", colour);
  return box;
};

/** @param {Legend} legend */
const scale = ({ ramp, least, most }) => {
  const bar = element("div", { class: "legend-ramp", "aria-hidden": "true" });
  bar.style.setProperty("background", `linear-gradient(to right, ${ramp.join(", ")})`);
  return [bar, element("div", { class: "legend-ends" }, element("span", {}, least), element("span", {}, most))];
};

/** @param {Legend} legend */
const one = (legend) =>
  element(
    "div",
    { class: "legend-part" },
    element("p", {}, legend.title),
    ...(legend.ramp.length ? scale(legend) : []),
    ...legend.entries.map(({ colour, label }) =>
      element("div", { class: "legend-entry" }, swatch(colour), element("span", {}, label))),
  );

/**
 * The legend of the texture, or those of both that are mixed.
 * @param {import("./model_loader.js").ModelLoader} loader
 * @returns {{element: HTMLElement, visible: boolean, toggle: (on: boolean) => void}}
 */
export const mountModelLegend = (loader) => {
  const box = element("div", { class: "model-legend", role: "group", "aria-label": "Legend", hidden: true });
  let visible = remembered();
  /** @type {(Legend | null)[]} */
  let legends = [];
  const show = () => {
    const titled = legends.filter((legend) => legend !== null).filter(({ title }) => title);
    box.hidden = !visible || !titled.length;
    if (!box.hidden) setChildren(box, ...titled.map(one));
  };
  loader.onChange(({ legend, second }) => {
    if (legend === legends[0] && second === legends[1]) return;
    legends = [legend, second];
    show();
  });
  return {
    element: box,
    get visible() {
      return visible;
    },
    toggle: (on) => {
      visible = on;
      remember(on);
      show();
    },
  };
};
