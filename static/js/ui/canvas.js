/** A canvas as large as its place, in CSS pixels whatever the screen's density, drawn anew when anything changes. */

import { element, inNextFrame } from "./dom.js";
import { view } from "../state/view.js";

/** @returns {(name: string) => string} the value of a custom property, as the theme has it now */
export const inks = () => {
  const style = getComputedStyle(document.documentElement);
  return (name) => style.getPropertyValue(name).trim();
};

/**
 * @param {Record<string, any>} properties of the canvas
 * @param {(context: CanvasRenderingContext2D, width: number, height: number, ink: (name: string) => string,
 *         em: number) => void} paint
 * @returns {{canvas: HTMLCanvasElement, draw: () => void}}
 */
export const makeCanvas = (properties, paint) => {
  const canvas = element("canvas", properties);
  const draw = inNextFrame(() => {
    const { clientWidth: width, clientHeight: height } = canvas;
    if (width === 0 || height === 0) return;
    const density = devicePixelRatio || 1;
    const [across, down] = [Math.round(width * density), Math.round(height * density)];
    if (canvas.width !== across || canvas.height !== down) Object.assign(canvas, { width: across, height: down });
    const context = canvas.getContext("2d");
    context.setTransform(density, 0, 0, density, 0, 0);
    context.clearRect(0, 0, width, height);
    const style = getComputedStyle(canvas);
    const em = Number.parseFloat(style.fontSize);
    context.font = `${em}px ${style.fontFamily}`;
    context.lineWidth = 1;
    paint(context, width, height, inks(), em);
  });
  new ResizeObserver(draw).observe(canvas);
  view.on((_, changed) => changed.has("theme") && draw());
  matchMedia("(prefers-color-scheme: light)").addEventListener("change", draw);
  return { canvas, draw };
};
