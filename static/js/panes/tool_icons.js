/** The few signs of the panes' buttons, drawn by hand on a grid of 16. */

const SHAPES = {
  line: "M3.5 12.5 12.5 3.5M2 12.5a1.5 1.5 0 1 0 3 0a1.5 1.5 0 1 0-3 0M11 3.5a1.5 1.5 0 1 0 3 0a1.5 1.5 0 1 0-3 0",
  point: "M8 1.5v4M8 10.5v4M1.5 8h4M10.5 8h4M7.2 8a.8.8 0 1 0 1.6 0a.8.8 0 1 0-1.6 0",
  select: "M4 2v10.5l2.8-2.6 1.9 4.1 1.8-.8-1.9-4h3.9z",
  loupe: "M2 7a5 5 0 1 0 10 0a5 5 0 1 0-10 0M10.6 10.6 14 14M7 4.8v4.4M4.8 7h4.4",
  snap: "M2.5 13.5v-11h11M5.5 8 8 5.5 10.5 8 8 10.5z",
  corners: "M3.5 2v3M2 3.5h3M12 5v3M10.5 6.5h3M6 10.5v3M4.5 12h3",
  link: "M6.5 9.5 9.5 6.5M7 4.5l1.8-1.8a2.7 2.7 0 0 1 3.8 3.8L10.9 8.3M9 11.5l-1.8 1.8a2.7 2.7 0 0 1-3.8-3.8L5.1 7.7",
};

const SVG = "http://www.w3.org/2000/svg";

/** @returns {SVGElement} */
export const icon = (name) => {
  const svg = document.createElementNS(SVG, "svg");
  svg.setAttribute("viewBox", "0 0 16 16");
  svg.setAttribute("aria-hidden", "true");
  svg.setAttribute("class", "pane-icon");
  const path = document.createElementNS(SVG, "path");
  path.setAttribute("d", SHAPES[name]);
  svg.append(path);
  return svg;
};
