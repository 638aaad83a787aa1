/** Points to be measured that are clicked on the model. */

import { drawing } from "../ui/canvas.js";
import { element } from "../ui/dom.js";
import { mountMeasureBar } from "./measure_bar.js";
import { drawPicked } from "./measured_layer.js";

const NOTHING_THERE = "The model has no surface there: click on it";
const OF_MODEL = ""; // the model is the surface of the project's scan, whatever is beside the photograph
const AS_ON_SCREEN = { x: 0, y: 0, zoom: 1 };

/**
 * @param {{body: HTMLElement, frame: HTMLIFrameElement, surface: import("../panels/model/model_surface.js").ModelSurface}} model
 * @param {import("./controller.js").Controller} controller
 */
export const mountModelMeasuring = ({ body, frame, surface }, controller) => {
  const { measuring, view, store } = controller;
  const canvas = element("canvas", { class: "model-picked", "aria-hidden": "true" });
  body.append(canvas);
  mountMeasureBar(controller, body);
  const measures = () => view.get().tool === "measure" && !store.readOnly;
  /** @type {WeakMap<number[], number[] | null>} */
  const onModel = new WeakMap();
  let drawn = "";

  /** @param {number[]} ndc */
  const clicked = (ndc) => {
    const found = surface.placeUnder(ndc);
    if (!found) return measuring.say(NOTHING_THERE);
    const { place, sigma } = found;
    const far = Math.hypot(...place);
    const uv = [ndc[0] * frame.clientWidth, ndc[1] * frame.clientHeight].map((length) => length / 2);
    const position = { world: place.map((value) => value / far), uv, zoom: 1, time_ms: performance.now() };
    return measuring.set("scan", position, { sigma, on: "model", station: OF_MODEL });
  };

  /** @param {number[]} ray */
  const screenOf = (ray) => {
    if (!onModel.has(ray)) onModel.set(ray, surface.placeOn(ray));
    const place = onModel.get(ray) ?? null;
    return place && surface.onScreen(place);
  };

  /** Draw what is picked anew when it or the view has changed. */
  const draw = () => {
    const rays = measures() ? measuring.runs("scan", OF_MODEL) : [];
    const size = [body.clientWidth, body.clientHeight];
    const now = rays.length ? [surface.viewpoint, size, JSON.stringify(rays)].join() : "";
    if (now !== drawn) {
      drawn = now;
      const scale = devicePixelRatio;
      [canvas.width, canvas.height] = size.map((length) => Math.round(length * scale));
      const context = drawing(canvas.getContext("2d"));
      context.scale(scale, scale);
      drawPicked(context, AS_ON_SCREEN, rays.map((run) => run.map(screenOf)), null, controller.look);
    }
    if (now) requestAnimationFrame(draw);
  };

  const follow = () => {
    surface.takeClicks(measures() ? clicked : null);
    surface.aims = measures();
  };
  const start = () => {
    try {
      const inner = frame.contentWindow;
      if (!inner) return;
      inner.addEventListener("pointerdown", () => surface.listenToClicks(), { capture: true });
      inner.addEventListener("pointermove", () => measures() && (surface.aims = true));
    } catch {
      return; // the browser's error page, which is not accessible
    }
    follow();
  };
  frame.addEventListener("load", start);
  view.on((_, changed) => changed.has("tool") && follow());
  store.watch(["people"], follow);
  measuring.onChange(() => drawn === "" && draw());
  follow();
};
