/** The heads of the two image panes: display, contrast, overlay of the scan on the photograph, and zoom. */

import { button, choice, fill, foldOut, press, slider, tickBox } from "../ui/controls.js";
import { element, setChildren } from "../ui/dom.js";
import { stationName } from "../state/stations.js";
import { axisOf } from "./projection.js";
import { anglesOf, directionLabel } from "./strip_geometry.js";
import { zoomText } from "./viewport.js";

/** @typedef {import("../state/view.js").ViewState} ViewState */

/**
 * @param {import("./controller.js").Controller} controller
 * @param {"scan" | "photo"} side
 * @returns {HTMLElement} zoom, one to one, fit
 */
const zoomControls = (controller, side) => {
  const pane = controller.panes[side];
  const name = side === "scan" ? "scan" : "photograph";
  const value = element("output", { class: "pane-zoom", title: `Zoom of the ${name}`, "aria-label": `Zoom of the ${name}`, "aria-live": "off" });
  const whole = button({
    label: `Fit the ${name}`,
    text: "Fit",
    title: "Fit the whole picture (0, or double click)",
    kind: "pane-button",
    act: () => pane.fit("hand"),
  });
  const single = button({
    label: `Show the ${name} one to one`,
    text: "1:1",
    title: "One image pixel per screen pixel (1)",
    kind: "pane-button pane-single",
    act: () => pane.zoomTo(1, "hand"),
  });
  const show = () => {
    value.textContent = pane.extent ? zoomText(pane.viewport.zoom) : "–";
  };
  pane.onMove(show);
  show();
  return element("div", { class: "pane-zooms" }, value, single, whole);
};

/** @type {[string, string][]} */
const DISPLAYS = [["intensity", "Intensity"], ["raw", "Raw intensity"], ["range", "Range"], ["shape", "Shape"], ["normals", "Normals"], ["edges", "Edges"]];
const DEFAULTS = { low: 1, high: 99.5, equalise: false, gamma: 0.6, brightness: 1, contrast: 1 };
const NUMBERS = /** @type {const} */ (["low", "high", "gamma", "brightness", "contrast"]);
const STRETCHED = new Set(["intensity", "raw", "range"]);

/** @param {import("../protocol.d.ts").PartnerChoice} station @returns {string} a station, and how much it sees of the photograph */
const stationText = ({ name, index, sees }) =>
  `${stationName({ name, index })}${sees === null ? "" : `, sees ${Math.round(100 * sees)} %`}`;

/** @param {number} value */
const percent = (value) => `${Number(value.toFixed(1))} %`;
/** @param {number} value */
const times = (value) => `×${value.toFixed(2)}`;

/**
 * Mount the controls of the scan's pane.
 * @param {HTMLElement} head
 * @param {import("./controller.js").Controller} controller
 */
export const mountScanHead = (head, controller) => {
  const { view, store } = controller;
  /** @param {Partial<ViewState["scan"]>} patch */
  const set = (patch) => view.set({ scan: patch });
  /** @param {Partial<ViewState["scan"]>} patch */
  const stretch = (patch) => view.set({ scan: patch, stretching: true });
  const released = () => view.set({ stretching: false });
  const station = choice("Scan beside the photograph", (name) => {
    const photo = store.shown();
    if (photo !== null) controller.ask("set_station", { photo, station: name }).catch((error) => {
      controller.report(error);
      show();
    });
  });
  const display = choice("Channel of the scan", (show) => set({ show }));
  const viewed = choice("View of the scan (Page Up, Page Down)", (index) => set({ view: Number(index) }));
  const rows = {
    low: slider({ label: "Black at", least: 0, most: 49, step: 0.5, text: percent, changed: (low) => stretch({ low }), released }),
    high: slider({ label: "White at", least: 51, most: 100, step: 0.1, text: percent, changed: (high) => stretch({ high }), released }),
    gamma: slider({ label: "Gamma", least: 0.2, most: 2, step: 0.05, text: (value) => value.toFixed(2), changed: (gamma) => stretch({ gamma }), released }),
    equalise: tickBox({ label: "Equalise the histogram", changed: (equalise) => set({ equalise }) }),
    brightness: slider({ label: "Brightness", least: 0.3, most: 3, step: 0.05, text: times, changed: (brightness) => set({ brightness }) }),
    contrast: slider({ label: "Contrast", least: 0.3, most: 3, step: 0.05, text: times, changed: (contrast) => set({ contrast }) }),
  };
  const reset = button({
    label: "Reset",
    title: "Reset contrast and brightness",
    kind: "pane-button",
    act: () => set(DEFAULTS),
  });
  const { opener, sheet } = foldOut("Contrast", "Contrast of the scan", ...Object.values(rows).map(({ row }) => row), reset);
  const zoom = zoomControls(controller, "scan");
  const beside = element("label", { class: "pane-station" }, element("span", { class: "dim" }, "Station"), station);
  station.className = "select";
  (head.closest(".pane-head") ?? head).after(beside);
  head.append(display, viewed, opener, sheet, zoom);

  const show = () => {
    const { scan } = view.get();
    const slice = store.scanBeside();
    const choices = store.get("partner")?.choices ?? [];
    fill(station, choices.map((each) => [each.station, stationText(each)]), store.station());
    beside.hidden = choices.length < 2;
    station.disabled = store.readOnly;
    station.title = "The scan that this photograph is matched with: that of the station that sees most of it, or the one chosen here";
    const displays = DISPLAYS.filter(([name]) => slice?.has_intensity !== false || !["intensity", "raw"].includes(name));
    if (slice?.has_color) displays.push(["color", "Colour"]);
    fill(display, displays, controller.sides.scan.stretch.show);
    const views = slice?.views ?? [];
    const { index: shown } = controller.sides.scan;
    // Views in between have no label: only the one that is shown is listed.
    /** @type {[string, string][]} */
    const listed = views.map((each, index) => [String(index), each.label || directionLabel(anglesOf(axisOf(each)))]);
    fill(viewed, listed.filter((_, index) => views[index].label || index === shown), String(shown));
    viewed.hidden = views.length < 2;
    for (const name of NUMBERS) rows[name].show(scan[name]);
    rows.equalise.show(scan.equalise);
    const stretches = STRETCHED.has(display.value);
    for (const row of [rows.low, rows.high, rows.gamma, rows.equalise]) row.row.hidden = !stretches;
    const range = scan.equalise ? " equalised" : ` ${scan.low}–${scan.high} %`;
    setChildren(opener, "Contrast", stretches ? element("span", { class: "pane-range" }, range) : null);
    for (const control of [display, viewed, opener]) control.disabled = !slice;
  };
  view.on((_, changed) => changed.has("scan") && show());
  store.watch(["scan", "beside", "partner", "shown", "people"], show);
  show();
};

/** @type {[ViewState["photo"]["overlay"], string][]} */
const OVERLAYS = [["none", "No overlay"], ["blend", "Blend"], ["swipe", "Swipe"], ["checker", "Checkerboard"], ["edges", "Edges"]];
/** @type {Partial<Record<string, ["blend" | "swipe", string]>>} by overlay */
const SLIDERS = { blend: ["blend", "Opacity of the scan"], edges: ["blend", "Opacity of the edges"], swipe: ["swipe", "Position of the swipe"] };

/**
 * Mount the controls of the photograph's pane.
 * @param {HTMLElement} head
 * @param {import("./controller.js").Controller} controller
 */
export const mountPhotoHead = (head, controller) => {
  const { view, store } = controller;
  /** @param {Partial<ViewState["photo"]>} patch */
  const set = (patch) => view.set({ photo: patch });
  const overlay = choice("Overlay of the scan on the photograph", (name) => set({ overlay: OVERLAYS.find(([each]) => each === name)?.[0] ?? "none" }));
  const share = element("input", { type: "range", class: "pane-share", min: 0, max: 1, step: 0.01 });
  share.addEventListener("input", () => set({ [SLIDERS[overlay.value]?.[0] ?? "blend"]: Number(share.value) }));
  const rows = {
    brightness: slider({ label: "Brightness", least: 0.3, most: 3, step: 0.05, text: times, changed: (brightness) => set({ brightness }) }),
    contrast: slider({ label: "Contrast", least: 0.3, most: 3, step: 0.05, text: times, changed: (contrast) => set({ contrast }) }),
  };
  const reset = button({
    label: "Reset",
    title: "Reset brightness and contrast",
    kind: "pane-button",
    act: () => set({ brightness: 1, contrast: 1 }),
  });
  const { opener, sheet } = foldOut("Contrast", "Brightness and contrast of the photograph", rows.brightness.row, rows.contrast.row, reset);
  const linked = button({
    label: "Linked",
    icon: "link",
    "aria-label": "Linked", // its text is hidden in narrow panes
    kind: "pane-button",
    act: () => view.set({ linked: !view.get().linked }),
  });
  const zoom = zoomControls(controller, "photo");
  head.append(overlay, share, opener, sheet, linked, zoom);

  const show = () => {
    const { photo, linked: isLinked, placement } = view.get();
    const { posed } = controller;
    const overlaid = posed || placement !== null;
    const shown = placement && photo.overlay === "none" ? "blend" : photo.overlay;
    fill(overlay, OVERLAYS, overlaid ? shown : "none");
    overlay.disabled = !overlaid;
    overlay.title = overlaid ? "Overlay of the scan on the photograph" : "The scan can be overlaid once there is a pose";
    const active = overlaid ? SLIDERS[shown] : undefined;
    share.hidden = !active;
    if (active) {
      share.value = String(photo[active[0]]);
      share.setAttribute("aria-label", active[1]);
      share.title = active[1];
    }
    rows.brightness.show(photo.brightness);
    rows.contrast.show(photo.contrast);
    opener.disabled = !store.photo();
    linked.disabled = !posed;
    press(linked, posed && isLinked);
    linked.title = posed ? "Link the two panes: both show the same place (K)" : "The panes can be linked once there is a pose";
  };
  view.on((_, changed) => (changed.has("photo") || changed.has("linked") || changed.has("placement")) && show());
  store.watch(["photos", "shown", "poses:*"], show);
  show();
};
