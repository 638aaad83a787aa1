/** The part below the panes: what it holds follows the step of the work. */

import { mountChain } from "../panels/pipeline.js";
import { mountCurves } from "../panels/convergence.js";
import { mountDepthPlot } from "../panels/depth_plot.js";
import { element } from "../ui/dom.js";
import { mountExport } from "../panels/export.js";
import { mountMatchTable } from "../panels/match_table.js";
import { mountStages } from "../panels/stages.js";
import { mountVerdict } from "../panels/verdict.js";
import { view } from "../state/view.js";

/** Which parts a step shows, in this order; each part is made once and only moved. */
const SHOWN = {
  match: ["table", "matching", "verdict"],
  solve: ["table", "chain", "curves"],
  judge: ["depth", "verdict", "stages"],
  export: ["export", "files", "verdict"],
};

/** @param {HTMLElement} dock */
export const mountDock = (dock) => {
  const [exporting, files] = mountExport();
  const parts = {
    table: mountMatchTable(),
    matching: mountChain("match", "Find matches"),
    chain: mountChain("all", "Solve step by step"),
    curves: mountCurves(),
    depth: mountDepthPlot(),
    verdict: mountVerdict(),
    stages: mountStages(),
    export: exporting,
    files,
  };
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
