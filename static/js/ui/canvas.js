/** A canvas that fills its box at the screen's resolution, and is redrawn when its size or the theme changes. */

import { element } from "./dom.js";
import { onTheme } from "./theme.js";
import { inNextFrame } from "./throttle.js";

/** @returns {(name: string) => string} reads a custom property, such as a colour of the current theme */
const themeColours = () => {
  const style = getComputedStyle(document.documentElement);
  return (name) => style.getPropertyValue(name).trim();
};

/**
 * @template Context
 * @param {Context | null} context what `getContext` has returned
 * @returns {Context}
 * @throws {Error} if there is none: the browser has no memory for it
 */
export const drawing = (context) => {
  if (context === null) throw new Error("The browser has no memory for another picture: close other tabs, then reload the page.");
  return context;
};

/**
 * @typedef {(context: CanvasRenderingContext2D, width: number, height: number, colour: (name: string) => string,
 *   em: number) => void} Paint draws in CSS pixels
 */

/**
 * @param {Record<string, any>} properties of the canvas
 * @param {Paint} paint
 * @returns {{canvas: HTMLCanvasElement, draw: () => void}} `draw` redraws in the next frame
 */
export const makeCanvas = (properties, paint) => {
  const canvas = element("canvas", properties);
  const draw = inNextFrame(() => {
    const { clientWidth: width, clientHeight: height } = canvas;
    if (width === 0 || height === 0) return;
    const density = devicePixelRatio || 1;
    const [across, down] = [Math.round(width * density), Math.round(height * density)];
    if (canvas.width !== across || canvas.height !== down) Object.assign(canvas, { width: across, height: down });
    const context = drawing(canvas.getContext("2d"));
    context.setTransform(density, 0, 0, density, 0, 0);
    context.clearRect(0, 0, width, height);
    const style = getComputedStyle(canvas);
    const em = Number.parseFloat(style.fontSize);
    context.font = `${em}px ${style.fontFamily}`;
    context.lineWidth = 1;
    paint(context, width, height, themeColours(), em);
  });
  new ResizeObserver(draw).observe(canvas);
  onTheme(draw);
  return { canvas, draw };
};
