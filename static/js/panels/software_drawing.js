/** A hint in the 3-D pane if the browser renders in software, where a coarser mesh helps. */

import { request } from "../net/requests.js";
import { store } from "../net/store.js";
import { button } from "../ui/controls.js";
import { element } from "../ui/dom.js";

const KEY = "ladarreg-software-drawing";
const SOFTWARE = /swiftshader|llvmpipe|softpipe|software|basic render/i;

/** @returns {string} name of the WebGL renderer; empty if there is none, or if the browser hides it */
const rendererName = () => {
  const context = document.createElement("canvas").getContext("webgl");
  if (!context) return "";
  const info = context.getExtension("WEBGL_debug_renderer_info");
  const name = context.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : context.RENDERER);
  context.getExtension("WEBGL_lose_context")?.loseContext(); // browsers limit their number
  return String(name);
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
  let slow = null; // unknown until there is something to render
  let hidden = dismissed();
  const hint = element(
    "div",
    { class: "software-hint", role: "status", hidden: true },
    element("span", {}, "3-D is slow: it is rendered without a graphics card."),
    button({
      label: "Coarse mesh",
      kind: "small",
      title: "Use a coarser mesh for all clients; the same switch above turns it off",
      act: () => request("set_model", { light: true }),
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
    const useful = !hidden && Boolean(store.get("scan")) && store.get("model")?.light === false;
    if (useful) slow ??= SOFTWARE.test(rendererName());
    hint.hidden = !(useful && slow);
  };
  body.append(hint);
  store.watch(["scan", "model"], show);
  show();
};
