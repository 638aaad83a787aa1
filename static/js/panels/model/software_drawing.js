/** A hint in the 3-D pane if the browser renders in software, where a coarser mesh helps. */

import { request } from "../../net/requests.js";
import { store } from "../../net/store.js";
import { button } from "../../ui/controls.js";
import { element } from "../../ui/dom.js";
import { whenPanesPainted } from "../../ui/first_pictures.js";

const KEY = "ladarreg-software-drawing";
const SOFTWARE = /swiftshader|llvmpipe|softpipe|software|basic render/i;

let most = 2048; // texture size, px: what any WebGL takes

/** @returns {string | null} name of the WebGL renderer, empty if the browser hides it; null without WebGL */
const findRenderer = () => {
  const context = document.createElement("canvas").getContext("webgl");
  if (!context) return null;
  const info = context.getExtension("WEBGL_debug_renderer_info");
  most = context.getParameter(context.MAX_TEXTURE_SIZE);
  const name = context.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : context.RENDERER);
  context.getExtension("WEBGL_lose_context")?.loseContext(); // browsers limit their number
  return String(name);
};

/** @type {string | null | undefined} unknown until there is something to render */
let renderer;
const rendererName = () => (renderer === undefined ? (renderer = findRenderer()) : renderer);

/** @returns {boolean} */
export const hasWebGL = () => rendererName() !== null;

/** @returns {boolean} whether the browser renders without a graphics card */
export const drawsInSoftware = () => SOFTWARE.test(rendererName() ?? "");

/** @returns {number} longer side of the largest texture, px */
export const largestTexture = () => {
  rendererName();
  return most;
};

const dismissed = () => {
  try {
    return localStorage.getItem(KEY) === "dismissed";
  } catch {
    return false; // storage is disabled: the hint is shown at each visit
  }
};

const dismiss = () => {
  try {
    localStorage.setItem(KEY, "dismissed");
  } catch {
    // storage is disabled: the hint is hidden for this visit
  }
};

/** Mount the hint. @param {HTMLElement} body of the model pane */
export const mountSoftwareHint = (body) => {
  let hidden = dismissed();
  const hint = element(
    "div",
    { class: "software-hint", role: "status", hidden: true },
    element("span", {}, "3-D is slow: it is rendered without a graphics card."),
    button({
      label: "Coarse mesh",
      kind: "small",
      title: "Use a coarser mesh and a smaller texture; Display, above, has the others",
      act: () => request("set_model", { detail: "coarse" }),
    }),
    button({
      label: "Do not show this again",
      icon: "close",
      kind: "plain small",
      bare: true,
      act: () => {
        hidden = true;
        dismiss();
        show();
      },
    }),
  );
  const show = () => {
    const useful = !hidden && Boolean(store.get("scan")) && (store.get("model")?.detail ?? "coarse") !== "coarse";
    hint.hidden = !(useful && drawsInSoftware());
    if (!hint.hidden) dismiss(); // at the next visit it is known
  };
  body.append(hint);
  whenPanesPainted().then(() => {
    store.watch(["scan", "model"], show);
    show();
  });
};
