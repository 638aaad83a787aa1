/** The legend of the texture that is drawn, over the 3-D view. */

import { element, setChildren } from "../../ui/dom.js";

const KEY = "ladarreg-model-legend";

const remembered = () => {
  try {
    return localStorage.getItem(KEY) !== "hidden";
  } catch {
    return true; // storage is disabled
  }
};

const remember = (visible) => {
  try {
    localStorage.setItem(KEY, visible ? "shown" : "hidden");
  } catch {
    // storage is disabled: the choice holds for this visit
  }
};

const swatch = (colour) => {
  const box = element("i", { class: "legend-swatch", "aria-hidden": "true" });
  box.style.setProperty("background", colour);
  return box;
};

const scale = ({ ramp, least, most }) => {
  const bar = element("div", { class: "legend-ramp", "aria-hidden": "true" });
  bar.style.setProperty("background", `linear-gradient(to right, ${ramp.join(", ")})`);
  return [bar, element("div", { class: "legend-ends" }, element("span", {}, least), element("span", {}, most))];
};

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
  /** @type {any[]} */
  let legends = [];
  const show = () => {
    const titled = legends.filter((legend) => legend?.title);
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
