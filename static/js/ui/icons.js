/** The icons of the page, on a grid of 16; they consist of strokes, so that they take the colour of the text. */

import { shape } from "./dom.js";

/** @type {Record<string, string>} */
const SHAPES = {
  undo: "M6 3 2.5 6.5 6 10M3 6.5h6.5a4 4 0 0 1 0 8H6",
  redo: "M10 3l3.5 3.5L10 10M13 6.5H6.5a4 4 0 0 0 0 8H10",
  plus: "M8 3v10M3 8h10",
  close: "M4 4l8 8M12 4l-8 8",
  tick: "M3 8.5 6.5 12 13 4.5",
  ring: "M8 2.5a5.5 5.5 0 1 1 0 11a5.5 5.5 0 1 1 0-11M5.6 8.2 7.3 10 10.6 6.2",
  cross: "M4.5 4.5l7 7M11.5 4.5l-7 7",
  fill: "M9.5 2.5h4v4M13.5 2.5l-4.5 4.5M6.5 13.5h-4v-4M2.5 13.5l4.5-4.5",
  unfill: "M13 6.5H9.5V3M9.5 6.5l4-4M3 9.5h3.5V13M6.5 9.5l-4 4",
  warn: "M8 2.5 14.5 13.5h-13zM8 6.5v3.5M8 11.9v.1",
  info: "M8 1.8a6.2 6.2 0 1 1 0 12.4a6.2 6.2 0 1 1 0-12.4M8 7.2v4M8 4.8v.1",
  bad: "M5.3 1.8h5.4l3.5 3.5v5.4l-3.5 3.5H5.3l-3.5-3.5V5.3zM5.8 5.8l4.4 4.4M10.2 5.8l-4.4 4.4",
  pause: "M5.5 3v10M10.5 3v10",
  play: "M4.5 2.8v10.4L13 8z",
  stop: "M4 4h8v8H4z",
  next: "M3.5 3v10L10 8zM12.5 3v10",
  dark: "M13.5 9.8A6 6 0 0 1 6.2 2.5a6 6 0 1 0 7.3 7.3z",
  light: "M8 5a3 3 0 1 1 0 6a3 3 0 1 1 0-6M8 1v1.5M8 13.5V15M1 8h1.5M13.5 8H15" +
    "M3 3l1.1 1.1M11.9 11.9 13 13M13 3l-1.1 1.1M4.1 11.9 3 13",
  system: "M1.8 3h12.4v8H1.8zM5.5 13.8h5M8 11v2.8",
  people: "M6 7.5a2.5 2.5 0 1 1 0-5a2.5 2.5 0 1 1 0 5M1.5 13.5c0-2.5 2-4 4.5-4s4.5 1.5 4.5 4" +
    "M10.5 2.8a2.5 2.5 0 0 1 0 4.5M12 9.8c1.6.5 2.5 1.8 2.5 3.7",
  help: "M5.5 5.8a2.5 2.5 0 1 1 3.7 2.2c-.8.5-1.2.9-1.2 1.8M8 12.3v.1",
  more: "M3.5 6 8 10.5 12.5 6",
  right: "M6 3.5 10.5 8 6 12.5",
  file: "M4 1.8h5L12.5 5.3v8.9H4zM9 1.8v3.5h3.5",
  folder: "M1.8 4v8.5h12.4V5.5H8L6.5 4z",
  download: "M8 2v8M4.5 7 8 10.5 11.5 7M2.5 13.5h11",
  target: "M8 4a4 4 0 1 1 0 8a4 4 0 1 1 0-8M8 1v4M8 11v4M1 8h4M11 8h4",
  running: "M8 2a6 6 0 1 1-5.2 3",
  dot: "M8 6.5a1.5 1.5 0 1 1 0 3a1.5 1.5 0 1 1 0-3",
  history: "M2.5 8a5.5 5.5 0 1 0 1.8-4.1M2.5 2.5v2.7h2.7M8 5v3.3l2.2 1.3",
  line: "M3.5 12.5 12.5 3.5M2 12.5a1.5 1.5 0 1 0 3 0a1.5 1.5 0 1 0-3 0M11 3.5a1.5 1.5 0 1 0 3 0a1.5 1.5 0 1 0-3 0",
  point: "M8 1.5v4M8 10.5v4M1.5 8h4M10.5 8h4M7.2 8a.8.8 0 1 0 1.6 0a.8.8 0 1 0-1.6 0",
  measure: "M1.8 10.5 10.5 1.8l3.7 3.7-8.7 8.7zM4.5 7.8l1.6 1.6M7.2 5.1l1.2 1.2M9.4 2.9 11 4.5",
  select: "M4 2v10.5l2.8-2.6 1.9 4.1 1.8-.8-1.9-4h3.9z",
  loupe: "M2 7a5 5 0 1 0 10 0a5 5 0 1 0-10 0M10.6 10.6 14 14M7 4.8v4.4M4.8 7h4.4",
  snap: "M2.5 13.5v-11h11M5.5 8 8 5.5 10.5 8 8 10.5z",
  marks: "M1.8 8C4.2 3.6 11.8 3.6 14.2 8C11.8 12.4 4.2 12.4 1.8 8zM8 6a2 2 0 1 1 0 4a2 2 0 1 1 0-4",
  corners: "M3.5 2v3M2 3.5h3M12 5v3M10.5 6.5h3M6 10.5v3M4.5 12h3",
  link: "M6.5 9.5 9.5 6.5M7 4.5l1.8-1.8a2.7 2.7 0 0 1 3.8 3.8L10.9 8.3M9 11.5l-1.8 1.8a2.7 2.7 0 0 1-3.8-3.8L5.1 7.7",
};

/**
 * @param {string} name
 * @returns {SVGElement} hidden from screen readers, since the text beside it has the same meaning
 */
export const icon = (name) =>
  shape("svg", { viewBox: "0 0 16 16", "aria-hidden": "true", class: `icon icon-${name}` }, shape("path", { d: SHAPES[name] }));
