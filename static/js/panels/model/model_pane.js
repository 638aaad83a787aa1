/** The 3-D model: viser's page in a frame below a cover, with viewpoints, texture, display options and legend. */

import { connectionState, onConnection } from "../../net/connection.js";
import { request } from "../../net/requests.js";
import { store } from "../../net/store.js";
import { button, foldOut, tickBox } from "../../ui/controls.js";
import { element, partOf, setAttribute, setChildren } from "../../ui/dom.js";
import { mountModelBlend } from "./model_blend.js";
import { mountModelCover } from "./model_cover.js";
import { mountModelFrame } from "./model_frame.js";
import { mountModelLegend } from "./model_legend.js";
import { choicesOf, ModelLoader, usableTexture } from "./model_loader.js";
import { mountPhotoSheet } from "./photo_sheet.js";
import { placingBar, roughPose } from "./rough_pose.js";
import { drawsInSoftware, mountSoftwareHint } from "./software_drawing.js";

/** @typedef {"overview" | "scanner" | "camera"} ViewpointName */

/** @type {[ViewpointName, string, string][]} */
const VIEWPOINTS = [
  ["overview", "Overview", "Look from outside at scanner, camera and model"],
  ["scanner", "Scanner", "Look from the scanner"],
  ["camera", "Camera", "Look from the camera of the photograph"],
];
/** @type {["cameras" | "matches" | "rays" | "residuals" | "z_buffer", string][]} */
const SWITCHES = [
  ["cameras", "Scanner and camera"],
  ["matches", "Matches"],
  ["rays", "Rays of the matches"],
  ["residuals", "Matches coloured by residual"],
  ["z_buffer", "Hide what the camera did not see (off: thesis Figure 2.23)"],
];
const DETAILS = [["coarse", "Coarse"], ["standard", "Standard"], ["dense", "Dense"]];

const viewpoints = () => {
  /** @type {[ViewpointName, string, HTMLButtonElement][]} */
  const buttons = VIEWPOINTS.map(([name, label, title]) => [
    name,
    title,
    button({ label, title, kind: "small", act: () => request("look", { viewpoint: name }) }),
  ]);
  const show = () => {
    const model = store.get("model");
    for (const [name, title, each] of buttons) {
      const missing = name === "camera" && !model?.accepted;
      each.disabled = !model || !store.get("scan") || missing;
      each.title = missing ? "Needs an accepted pose" : title;
    }
  };
  store.watch(["model", "scan"], show);
  show();
  return element(
    "div",
    { class: "viewpoints", role: "group", "aria-label": "Viewpoint" },
    ...buttons.map(([, , each]) => each),
  );
};

const textureSelect = () => {
  const select = element("select", {
    class: "select",
    "aria-label": "Texture of the model",
    title: "Texture of the model",
    on: { change: () => request("set_model", { texture: select.value }) },
  });
  let drawn = "";
  const show = () => {
    const model = store.get("model");
    const text = JSON.stringify(model?.choices ?? []);
    if (text !== drawn) {
      drawn = text;
      setChildren(
        select,
        ...(model ? choicesOf(model) : []).map(({ value, label, usable, said }) =>
          element("option", { value, disabled: !usable, title: said }, usable ? label : `${label} · not available yet`)),
      );
    }
    if (model) select.value = usableTexture(model);
    select.disabled = !model;
  };
  store.watch(["model"], show);
  show();
  return select;
};

/** @param {HTMLElement} blend the choice of a second texture @param {ReturnType<typeof mountModelLegend>} legend */
const display = (legend, blend) => {
  const switches = SWITCHES.map(([name, label]) => /** @type {const} */ ([
    name,
    tickBox({ label, changed: (on) => request("set_model", { [name]: on }) }),
  ]));
  const shown = tickBox({ label: "Legend", changed: (on) => legend.toggle(on) });
  shown.show(legend.visible);
  const detail = element(
    "select",
    { class: "select", "aria-label": "Detail", on: { change: () => request("set_model", { detail: detail.value }) } },
    ...DETAILS.map(([value, label]) => element("option", { value }, label)),
  );
  const row = element("label", { class: "pane-row" }, element("span", {}, "Detail"), detail);
  const fold = foldOut("Display", "What the 3-D view shows", ...switches.map(([, each]) => each.row), shown.row, row, blend);
  const show = () => {
    const model = store.get("model");
    fold.opener.disabled = !model;
    if (!model) return;
    for (const [name, each] of switches) each.show(model[name]);
    detail.value = model.detail;
  };
  store.watch(["model"], show);
  show();
  fold.sheet.append(roughPose(fold.sheet));
  return [fold.opener, fold.sheet];
};

/** Hide scanner, camera and matches in the 3-D view, or show them again. */
export const toggleMarks = () => {
  const model = store.get("model");
  if (!model) return;
  const show = !(model.cameras || model.matches);
  request("set_model", { cameras: show, matches: show });
};

/**
 * Mount the frame and its controls.
 * @param {HTMLElement} pane
 * @returns {{body: HTMLElement, frame: HTMLIFrameElement, surface: import("./model_surface.js").ModelSurface}}
 */
export const mountModelPane = (pane) => {
  const body = partOf(pane, ".pane-body");
  const frame = element("iframe", { class: "model-frame", title: "3-D model", allow: "fullscreen" });
  const empty = element("p", { class: "pane-empty", hidden: true });
  const loader = new ModelLoader(frame, drawsInSoftware);
  const cover = mountModelCover(loader);
  const legend = mountModelLegend(loader);
  const blend = mountModelBlend(loader);
  const chip = element("p", { class: "model-loading", role: "status", hidden: true });
  body.append(frame, cover.element, mountPhotoSheet(loader), blend.bar, legend.element, chip, empty, placingBar());
  partOf(pane, ".pane-controls").append(viewpoints(), textureSelect(), ...display(legend, blend.row));
  mountModelFrame(frame, { loaded: (got, total) => loader.count("viewer", got, total), failed: cover.fail });
  mountSoftwareHint(body);
  loader.onChange(({ state, got, total, error, whole, mixed }) => {
    const busy = state === "drawn" && total > 0;
    chip.hidden = !busy && !(state === "drawn" && error);
    chip.textContent = busy ? `loading ${kB(got)} of ${kB(total)} kB` : error;
    setAttribute(body, "data-model", state);
    setAttribute(body, "data-whole", whole ? "yes" : null);
    setAttribute(body, "data-mixed", mixed ? "yes" : null);
  });
  const show = () => {
    const without = connectionState() === "connected" && !store.get("scan") && !store.get("acquisition")?.points;
    setChildren(empty, without ? "The scan is shown here as a surface, with the camera." : "");
    empty.hidden = !without;
  };
  store.watch(["scan", "acquisition"], show);
  onConnection(show);
  show();
  return { body, frame, surface: loader.surface };
};

/** @param {number} bytes */
const kB = (bytes) => Math.round(bytes / 1000);
