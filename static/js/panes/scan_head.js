/** The head of the scan's pane: what of the scan is shown, and how strongly. */

import { button, choice, fill, foldOut, slider, tickBox } from "../ui/controls.js";
import { zoomControls } from "./zoom_head.js";

const DISPLAYS = [["intensity", "Intensity"], ["raw", "Raw intensity"], ["range", "Range"], ["normals", "Normals"], ["edges", "Edges"]];
const PLAIN = { low: 1, high: 99.5, equalise: false, gamma: 0.6, brightness: 1, contrast: 1 };
const STRETCHED = new Set(["intensity", "raw", "range"]);

const percent = (value) => `${Number(value.toFixed(1))} %`;
const times = (value) => `×${value.toFixed(2)}`;

/** @param {HTMLElement} head @param {import("./controller.js").Desk} desk */
export const mountScanHead = (head, desk) => {
  const { view, store } = desk;
  const set = (patch) => view.set({ scan: patch });
  const display = choice("What the scan shows", (show) => set({ show }));
  const viewed = choice("View of the scan (Page Up, Page Down)", (index) => set({ view: Number(index) }));
  const rows = {
    low: slider({ label: "Black at", least: 0, most: 49, step: 0.5, text: percent, changed: (low) => set({ low }) }),
    high: slider({ label: "White at", least: 51, most: 100, step: 0.1, text: percent, changed: (high) => set({ high }) }),
    gamma: slider({ label: "Gamma", least: 0.2, most: 2, step: 0.05, text: (value) => value.toFixed(2), changed: (gamma) => set({ gamma }) }),
    equalise: tickBox({ label: "Equalise the histogram", changed: (equalise) => set({ equalise }) }),
    brightness: slider({ label: "Brightness", least: 0.3, most: 3, step: 0.05, text: times, changed: (brightness) => set({ brightness }) }),
    contrast: slider({ label: "Contrast", least: 0.3, most: 3, step: 0.05, text: times, changed: (contrast) => set({ contrast }) }),
  };
  const plain = button("As at first", "Contrast and brightness as at first", () => set(PLAIN));
  const { opener, sheet } = foldOut("Contrast", "Contrast of the scan's picture", ...Object.values(rows).map(({ row }) => row), plain);
  const zoom = zoomControls(desk, "scan");
  head.append(display, viewed, opener, sheet, zoom.element);

  const show = () => {
    const { scan } = view.get();
    const told = store.get("scan");
    const offered = DISPLAYS.filter(([name]) => name !== "intensity" || told?.has_intensity !== false);
    if (told?.has_color) offered.push(["color", "Colour"]);
    fill(display, offered, offered.some(([name]) => name === scan.show) ? scan.show : offered[0][0]);
    const views = told?.views ?? [];
    fill(viewed, views.map(({ label }, index) => [String(index), label || `View ${index + 1}`]), String(desk.sides.scan.index));
    viewed.hidden = views.length < 2;
    for (const [name, { show: put }] of Object.entries(rows)) put(scan[name]);
    const stretches = STRETCHED.has(display.value);
    for (const name of ["low", "high", "gamma", "equalise"]) rows[name].row.hidden = !stretches;
    opener.replaceChildren("Contrast");
    if (stretches) {
      const figures = document.createElement("span");
      figures.textContent = scan.equalise ? " equalised" : ` ${scan.low}–${scan.high} %`;
      opener.append(figures);
    }
    for (const control of [display, viewed, opener]) control.disabled = !told;
  };
  view.on((_, changed) => changed.has("scan") && show());
  store.watch(["scan"], show);
  show();
};
