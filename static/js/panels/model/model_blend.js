/** Two textures of the model, mixed as a slider says: both are loaded once, and the graphics card mixes them. */

import { store } from "../../net/store.js";
import { slider } from "../../ui/controls.js";
import { element, setChildren } from "../../ui/dom.js";
import { blendable, choicesOf, usableTexture } from "./model_loader.js";

const NONE = "";
const HALF = 0.5;

/**
 * @param {import("./model_loader.js").ModelLoader} loader
 * @returns {{bar: HTMLElement, row: HTMLElement}} the slider, over the 3-D view, and the choice of the second texture
 */
export const mountModelBlend = (loader) => {
  let chosen = NONE;
  let [first, second] = ["", ""];
  let drawn = "";
  const select = element("select", {
    class: "select",
    "aria-label": "Blend with",
    title: "A second texture, mixed into the first one by a slider",
    on: { change: () => choose(select.value) },
  });
  const share = slider({
    label: "Blend",
    least: 0,
    most: 1,
    step: 0.01,
    text: (value) => `${Math.round(100 * (1 - value))} % ${first}, ${Math.round(100 * value)} % ${second}`,
    changed: (value) => set(value),
  });
  const bar = element("div", { class: "model-blend", role: "group", "aria-label": "Blend of two textures", hidden: true }, share.row);
  let part = HALF;

  const set = (/** @type {number} */ value) => {
    part = value;
    loader.surface.share = value;
    share.show(value);
  };
  const choose = (/** @type {string} */ kind) => {
    chosen = kind;
    set(HALF);
    show();
  };
  const show = () => {
    const model = store.get("model");
    const others = model ? blendable(model) : [];
    const other = others.find(({ value }) => value === chosen);
    const text = JSON.stringify(others);
    if (text !== drawn) {
      drawn = text;
      setChildren(
        select,
        element("option", { value: NONE }, "Nothing"),
        ...others.map(({ value, label }) => element("option", { value }, label)),
      );
    }
    select.value = other ? chosen : NONE;
    select.disabled = !others.length;
    bar.hidden = !other;
    loader.blendWith(other ? chosen : NONE);
    if (!model || !other) return;
    first = choicesOf(model).find(({ value }) => value === usableTexture(model))?.label ?? "";
    second = other.label;
    share.show(part);
  };
  store.watch(["model"], show);
  set(HALF);
  show();
  return { bar, row: element("label", { class: "pane-row" }, element("span", {}, "Blend with"), select) };
};
