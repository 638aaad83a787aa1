/** The stages side by side (thesis Tables 3.2-3.5); a click shows a stage and its verdict. */

import { requestForPhoto } from "../../net/requests.js";
import { store } from "../../net/store.js";
import { button } from "../../ui/controls.js";
import { element, setChildren } from "../../ui/dom.js";
import { icon } from "../../ui/icons.js";
import { lightOf } from "../../ui/lights.js";
import { duration, fixed, NONE, parameterName, typeset } from "../../ui/numbers.js";
import { auditReport } from "./audit.js";

/** @typedef {import("../../net/store.js").Stage} Stage @typedef {[string, (stage: Stage) => string | Node]} Figure */

/** @type {Figure[]} */
const FIGURES = [
  ["matches that agree", (stage) => (stage.matches === undefined ? NONE : `${stage.inliers} of ${stage.matches}`)],
  ["σ of position", (stage) => stage.summary?.position || NONE],
  ["residual, median px", (stage) => fixed(stage.median_px, 2)],
  ["depth error, rms m", (stage) => fixed(stage.rms_depth_m, 3)],
  ["focal length px", (stage) => fixed(stage.focal_px, 1)],
  ["time", (stage) => duration(stage.seconds)],
];

/** @param {Stage[]} stages @returns {Figure[]} */
const parameterRows = (stages) => {
  /** @type {{name: string, unit: string}[]} */
  const names = stages.find(({ parameters }) => parameters?.length)?.parameters ?? [];
  return names.map((named, index) => [
    parameterName(named),
    (stage) => {
      const found = stage.parameters?.[index];
      if (!found) return NONE;
      const sigma = found.sigma && found.sigma !== "unknown" ? ` ± ${found.sigma}` : "";
      return element("span", { title: `${typeset(found.value)}${sigma}` }, typeset(found.value));
    },
  ]);
};

/** @param {Stage[]} stages @param {string | null} shown */
const table = (stages, shown) => {
  const heads = stages.map((stage) => {
    const present = stage.stage === shown;
    const word = stage.stale ? `out of date: ${stage.stale}` : stage.summary?.words ?? "";
    const { sign, level } = lightOf(stage.summary?.light);
    const opener = button({
      label: stage.label,
      kind: "stage plain",
      title: present ? `Shown: ${word}` : `Show ${stage.label}: ${word}`,
      "aria-pressed": String(present),
      act: () => present || store.readOnly || requestForPhoto("use_stage", { stage: stage.stage }),
    });
    setChildren(
      opener,
      element("span", { class: `sign ${level}` }, icon(sign)),
      element("span", {}, stage.label),
      element("span", { class: "visually-hidden" }, `, ${word}`),
    );
    return element("th", { scope: "col", class: present ? "shown" : "" }, opener);
  });
  const rows = [...parameterRows(stages), ...FIGURES].map(([name, cell]) =>
    element(
      "tr",
      {},
      element("th", { scope: "row" }, name),
      ...stages.map(
        (stage) => element("td", { class: `figures ${stage.stage === shown ? "shown" : ""}` }, cell(stage)),
      ),
    ),
  );
  return element(
    "table",
    { class: "stages" },
    element("thead", {}, element("tr", {}, element("td", {}), ...heads)),
    element("tbody", {}, ...rows),
  );
};

/** @param {{sentence: string, advice?: string, counts?: string}} found slice `self_test:pID` */
const selfTest = (found) =>
  element(
    "section",
    { class: "self-test", "aria-label": "Self-test" },
    element("h3", {}, "Self-test"),
    element("p", {}, found.sentence, found.advice ? element("span", { class: "dim" }, ` ${found.advice}`) : null),
    found.counts ? element("p", { class: "dim" }, found.counts) : null,
  );

/** @returns {HTMLElement} */
export const mountStages = () => {
  const body = element("div", { class: "part-body" });
  const part = element(
    "section",
    { class: "dock-part stages-part", "aria-label": "Stages side by side" },
    element(
      "div",
      { class: "part-head" },
      element("h2", {}, "Stages"),
      element(
        "div",
        { class: "end" },
        button({
          label: "Compare all",
          kind: "small edits",
          title: "Solve with every method and compare the results",
          act: () => requestForPhoto("run", { job: "compare" }),
        }),
        button({
          label: "Self-test",
          kind: "small edits",
          title: "Register photographs simulated from this scan and compare with the true poses: estimates what to expect",
          act: () => requestForPhoto("run", { job: "self_test" }),
        }),
        button({
          label: "Audit",
          kind: "small edits",
          title: "Judge the pose that a file states for the photograph, or else the current one: is it still right, and how small an error would the images show?",
          act: () => requestForPhoto("run", { job: "audit" }),
        }),
      ),
    ),
    body,
  );
  let drawn = "";
  const scrollToShown = () => {
    /** @type {HTMLElement | null} */
    const column = body.querySelector("th.shown");
    if (column) body.scrollLeft = Math.max(0, column.offsetLeft + column.offsetWidth - body.clientWidth);
  };
  const show = () => {
    const poses = store.posesOf();
    const found = store.get(`self_test:${store.shown()}`);
    const audited = store.get(`audit:${store.shown()}`);
    const text = JSON.stringify([poses?.shown, poses?.stages, found, audited]);
    if (text === drawn) return;
    drawn = text;
    setChildren(
      body,
      poses?.stages?.length ? table(poses.stages, poses.shown) : element(
        "p",
        { class: "empty" },
        "Each method becomes a column here; Compare all runs them in sequence.",
      ),
      audited ? auditReport(audited) : null,
      found ? selfTest(found) : null,
    );
    scrollToShown();
  };
  new ResizeObserver(scrollToShown).observe(body); // it has no width while another step is shown
  store.watch(["poses:*", "self_test:*", "audit:*", "shown"], show);
  show();
  return part;
};
