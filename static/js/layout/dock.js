/** The dock below the panes: its panels depend on the current step. */

import { mountDevices } from "../panels/acquire/devices.js";
import { mountPlanForm } from "../panels/acquire/plan_form.js";
import { mountRun } from "../panels/acquire/run.js";
import { mountConvergence } from "../panels/pose/convergence.js";
import { mountDepthPlot } from "../panels/pose/depth_plot.js";
import { mountMeasurements } from "../panels/pose/measurements.js";
import { mountExport } from "../panels/export/export.js";
import { mountMatchTable } from "../panels/matches/match_table.js";
import { mountPipeline } from "../panels/matches/pipeline.js";
import { mountStages } from "../panels/pose/stages.js";
import { mountPhotographs } from "../panels/stations/photographs.js";
import { mountStations } from "../panels/stations/stations.js";
import { mountVerdict } from "../panels/pose/verdict.js";
import { view } from "../state/view.js";
import { element } from "../ui/dom.js";

/** The panels of each step, in order; each panel is created once and then only shown or hidden. */
const SHOWN = {
  acquire: ["devices", "plan", "run"],
  stations: ["photographs", "stations", "fit"],
  match: ["table", "methods", "verdict"],
  solve: ["table", "methods", "convergence"],
  judge: ["depth", "verdict", "measurements", "stages"],
  export: ["export", "files", "verdict"],
};

/** @param {HTMLElement} dock */
export const mountDock = (dock) => {
  const [exporting, files] = mountExport();
  const [stations, fit] = mountStations();
  const parts = {
    devices: mountDevices(),
    plan: mountPlanForm(),
    run: mountRun(),
    photographs: mountPhotographs(),
    stations,
    fit,
    table: mountMatchTable(),
    methods: mountPipeline(),
    convergence: mountConvergence(),
    depth: mountDepthPlot(),
    verdict: mountVerdict(),
    measurements: mountMeasurements(),
    stages: mountStages(),
    export: exporting,
    files,
  };
  files.querySelector(".part-body")?.setAttribute("tabindex", "0"); // scrolled by keys: nothing in it takes the focus
  const row = element("div", { class: "dock-row" }, ...Object.values(parts));
  dock.append(row);
  dock.setAttribute("role", "tabpanel");
  const show = () => {
    const { step } = view.get();
    const shown = SHOWN[step] ?? SHOWN.match;
    dock.dataset.step = step;
    dock.setAttribute("aria-labelledby", `step-${step}`);
    for (const [name, part] of Object.entries(parts)) {
      part.hidden = !shown.includes(name);
      part.style.setProperty("order", String(shown.indexOf(name)));
    }
  };
  view.on((_, changed) => changed.has("step") && show());
  show();
};
