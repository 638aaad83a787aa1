/** Zoom of a pane: how much, one to one, the whole. */

import { element } from "../ui/dom.js";
import { button } from "../ui/controls.js";
import { zoomText } from "./viewport.js";

/** @param {import("./controller.js").Desk} desk @param {"scan" | "photo"} side @returns {{element: HTMLElement}} */
export const zoomControls = (desk, side) => {
  const pane = desk.panes[side];
  const name = side === "scan" ? "scan" : "photograph";
  const said = element("output", { class: "pane-zoom", title: `Zoom of the ${name}`, "aria-label": `Zoom of the ${name}`, "aria-live": "off" });
  const whole = button(`Fit the ${name}`, "The whole picture (0, or double click)", () => pane.fit("hand"), "Fit");
  const single = button(`${name} one to one`, "One pixel of the picture on one of the page (1)", () => pane.zoomTo(1, "hand"), "1:1");
  single.classList.add("pane-single");
  const show = () => {
    said.textContent = pane.extent ? zoomText(pane.viewport.zoom) : "–";
  };
  pane.onMove(show);
  show();
  return { element: element("div", { class: "pane-zooms" }, said, single, whole) };
};
