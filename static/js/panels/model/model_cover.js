/** A dark cover over the 3-D view until the model is drawn, with what has been loaded. */

import { store } from "../../net/store.js";
import { element, setText } from "../../ui/dom.js";
import { whenPanesPainted } from "../../ui/first_pictures.js";
import { hasWebGL } from "./software_drawing.js";

const MB = 1e6;
const NO_WEBGL =
  "The 3-D view needs WebGL, which this browser does not offer: allow hardware acceleration in its settings.";

/**
 * @param {import("./model_loader.js").ModelLoader} loader
 * @returns {{element: HTMLElement, fail: (sentence: string) => void}} `fail` shows why there is no 3-D view
 */
export const mountModelCover = (loader) => {
  const text = element("p", { role: "status" });
  const bar = element("progress", { "aria-label": "Loading of the model", max: 1 });
  const cover = element("div", { class: "model-cover" }, text, bar);
  let failure = "", painted = false;
  let last = { state: "empty", got: 0, total: 0, error: "" };
  const show = () => {
    const { state, got, total, error } = last;
    const open = Boolean(store.get("scan"));
    const why = failure || error || (open && painted && !hasWebGL() ? NO_WEBGL : "");
    const run = Boolean(store.get("acquisition")?.points); // its points are drawn without the page's help
    cover.classList.toggle("gone", (state === "drawn" || run) && !failure);
    const share = total ? got / total : 0;
    bar.hidden = !open || Boolean(why);
    if (total) bar.value = share;
    else bar.removeAttribute("value");
    if (why) setText(text, why);
    else if (!open) setText(text, "");
    else if (!total) setText(text, "The model is being prepared");
    else if (share < 1) setText(text, `model ${(got / MB).toFixed(1)} of ${(total / MB).toFixed(1)} MB`);
    else setText(text, "The model is being drawn");
  };
  loader.onChange((state) => {
    last = state;
    show();
  });
  store.watch(["scan", "acquisition"], show);
  whenPanesPainted().then(() => {
    painted = true;
    show();
  });
  return {
    element: cover,
    fail: (sentence) => {
      failure = sentence;
      show();
    },
  };
};
