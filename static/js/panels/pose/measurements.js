/** The list of measurements: value, interval and notes of each; selected, renamed, removed and exported here. */

import { request } from "../../net/requests.js";
import { store } from "../../net/store.js";
import { isRunning } from "../../state/pipeline.js";
import { measurementsNow } from "../../state/measuring.js";
import { scanOfStation, stationName, stationsNow } from "../../state/stations.js";
import { view } from "../../state/view.js";
import { button } from "../../ui/controls.js";
import { element, setChildren, setText } from "../../ui/dom.js";

/** @typedef {import("../../state/measuring.js").Measurement} Measurement */

const EMPTY = "Choose a kind, and click the points in the scan, in a registered photograph, or on the model.";

/**
 * @param {Measurement} measurement
 * @returns {string} the interval of a measurement, and where there are several the scan that it was made on
 */
const about = ({ interval, station }) =>
  [interval && `95 %: ${interval}`, stationsNow().stations.length && `on ${scanOfStation(station)}`].filter(Boolean).join(" · ");

/** @returns {HTMLElement} */
export const mountMeasurements = () => {
  let saves = false;
  const list = element("ul", { class: "measurement-list", "aria-label": "Measurements" });
  const empty = element("p", { class: "empty" }, EMPTY);
  const measure = button({
    label: "Measure",
    kind: "small edits",
    icon: "measure",
    title: "Pick points in the pictures or on the model (D)",
    act: () => view.set({ tool: "measure" }),
  });
  const save = button({
    label: "Export the measurements",
    text: "Export",
    kind: "small",
    icon: "download",
    title: "A zip of the list as CSV, JSON, GeoJSON and DXF",
    act: async () => {
      saves = Boolean(await request("export", { targets: ["measurements"], photos: [] }));
    },
  });
  const part = element(
    "section",
    { class: "dock-part measurements", "aria-label": "Measurements" },
    element("div", { class: "part-head" }, element("h2", {}, "Measurements"), element("div", { class: "end" }, measure, save)),
    element("div", { class: "part-body" }, empty, list),
  );

  /** @param {Measurement} one @param {HTMLInputElement} input */
  const rename = (one, input) => {
    const name = input.value.trim();
    if (name !== one.name) request("rename_measurement", { measurement: one.id, name });
  };

  const row = (/** @type {Measurement} */ one) => {
    const name = element("input", {
      type: "text",
      class: "measurement-name",
      value: one.name,
      maxLength: 60,
      readOnly: store.readOnly,
      "aria-label": `Name of ${one.name}`,
      on: {
        change: () => rename(one, name),
        keydown: (event) => event.key === "Enter" && name.blur(),
        focus: () => view.set({ measurement: one.id }),
      },
    });
    const said = one.refusal ? [one.refusal] : one.notes;
    return element(
      "li",
      { class: `measurement ${one.kind}`, "data-measurement": one.id, on: { click: () => view.set({ measurement: one.id }) } },
      element(
        "div",
        { class: "measurement-line" },
        name,
        element("strong", { class: "figures measurement-value" }, one.known ? one.value || "Not measured" : "…"),
        button({
          label: `Remove ${one.name}`,
          icon: "close",
          bare: true,
          kind: "small plain edits",
          act: () => request("remove_measurements", { measurements: [one.id] }),
        }),
      ),
      about(one) ? element("p", { class: "dim figures" }, about(one)) : null,
      ...said.map((note) => element("p", { class: "measurement-note" }, note)),
    );
  };

  const mark = () => {
    const { measurement } = view.get();
    for (const item of list.children) {
      const chosen = item.getAttribute("data-measurement") === measurement;
      if (chosen && !item.classList.contains("chosen")) item.scrollIntoView({ block: "nearest" });
      item.classList.toggle("chosen", chosen);
    }
  };

  /** @type {Measurement[] | null} */
  let drawn = null;
  let named = "";
  const show = () => {
    const all = measurementsNow();
    const { tool } = view.get();
    part.classList.toggle("unused", all.length === 0 && tool !== "measure");
    measure.disabled = !store.get("scan") || store.readOnly;
    save.disabled = all.length === 0 || isRunning(store.get("job")) || store.readOnly;
    empty.hidden = all.length > 0;
    setText(empty, EMPTY);
    // a name that is being typed is not taken away
    const scans = stationsNow().stations.map(stationName).join("\n");
    if ((all !== drawn || scans !== named) && !list.contains(document.activeElement?.closest("input[type=text]") ?? null)) {
      drawn = all;
      named = scans;
      setChildren(list, ...all.map(row));
    }
    mark();
  };
  list.addEventListener("focusout", () => setTimeout(show));
  store.watch(["measurements", "measured", "stations", "scan", "job", "people"], show);
  store.onEvent("export_ready", ({ targets, url }) => {
    if (saves && targets.includes("measurements")) element("a", { href: url, download: "" }).click();
    saves = false;
  });
  view.on((_, changed) => {
    if (changed.has("tool")) show();
    if (changed.has("measurement")) mark();
  });
  show();
  return part;
};
