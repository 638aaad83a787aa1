/** A line in the 3-D pane where the browser draws by the processor: a lighter model helps there. */

import { button, element } from "../ui/dom.js";
import { wish } from "../net/requests.js";
import { store } from "../net/store.js";

const KEY = "ladarreg-software-drawing";
const SOFTWARE = /swiftshader|llvmpipe|softpipe|software|basic render/i;

/** @returns {string} what draws WebGL here, as the browser names it; empty where nothing does or it keeps it secret */
const rendererName = () => {
  const context = document.createElement("canvas").getContext("webgl");
  if (!context) return "";
  const info = context.getExtension("WEBGL_debug_renderer_info");
  const name = context.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : context.RENDERER);
  context.getExtension("WEBGL_lose_context")?.loseContext(); // a browser has but few
  return String(name);
};

const dismissed = () => {
  try {
    return localStorage.getItem(KEY) === "dismissed";
  } catch {
    return false; // storage is off: it is said at each visit
  }
};

const dismiss = () => {
  try {
    localStorage.setItem(KEY, "dismissed");
  } catch {
    // storage is off: it is away for this visit
  }
};

/** @param {HTMLElement} body of the model's pane */
export const mountSoftwareHint = (body) => {
  let slow = null; // not known before there is something to draw
  let away = dismissed();
  const hint = element(
    "div",
    { class: "software-hint", role: "status", hidden: true },
    element("span", {}, "3-D is slow here: no graphics card draws it."),
    button({
      label: "Light model",
      kind: "small",
      title: "A coarser mesh, for all who are here; the switch “light” above takes it back",
      act: () => wish("set_model", { light: true }),
    }),
    button({
      label: "Do not say this again",
      icon: "close",
      kind: "plain small",
      bare: true,
      act: () => {
        away = true;
        dismiss();
        show();
      },
    }),
  );
  const show = () => {
    const wanted = !away && Boolean(store.get("scan")) && store.get("model")?.light === false;
    if (wanted) slow ??= SOFTWARE.test(rendererName());
    hint.hidden = !(wanted && slow);
  };
  body.append(hint);
  store.watch(["scan", "model"], show);
  show();
};
