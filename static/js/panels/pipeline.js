/** The steps of the thesis in order, each with its state, its settings and a button to run it. */

import { requestForPhoto } from "../net/requests.js";
import { store } from "../net/store.js";
import { GENERAL, isRunning, PIPELINE, settingsOf, stepState } from "../state/pipeline.js";
import { button } from "../ui/controls.js";
import { element, setAttribute, setChildren, setText } from "../ui/dom.js";
import { icon } from "../ui/icons.js";
import { settingsForm } from "./settings_form.js";

const ICONS = { none: "dot", running: "running", paused: "pause", done: "tick", failed: "bad", stopped: "stop", stale: "warn" };
const LEVELS = { none: "dim", running: "accent", paused: "warn", done: "ok", failed: "bad", stopped: "warn", stale: "warn" };
const STATES = {
  none: "not run",
  running: "running",
  paused: "paused",
  done: "done",
  failed: "failed",
  stopped: "stopped",
  stale: "out of date",
};

/** The newest finished job of each kind and photograph; slice `job` contains only the last one of all. */
const finished = new Map();
store.on("job", (job) => {
  if (job && !isRunning(job)) finished.set(`${job.photo} ${job.kind}`, job);
});

/**
 * @param {"match" | "solve" | "all"} the steps to show
 * @param {string} title
 * @returns {HTMLElement}
 */
export const mountPipeline = (which, title) => {
  const steps = PIPELINE.filter((step) => which === "all" || step.in === which);
  let chosen = steps[0];
  let drawn = "";
  let form = null;
  const list = element("ol", { class: "pipeline", "aria-label": title });
  const pane = element("div", { class: "pipeline-settings" });
  const failure = element("p", { class: "bad pipeline-failure", role: "status" });
  const rows = new Map();

  const run = (step) => {
    choose(step);
    requestForPhoto("run", { job: step.job });
  };
  const choose = (step) => {
    chosen = step;
    show();
  };
  for (const step of [...steps, GENERAL]) {
    const sign = element("span", { class: "sign" });
    const status = element("span", { class: "clip dim pipeline-status" });
    const word = element("span", { class: "visually-hidden" });
    const open = element(
      "button",
      { type: "button", class: "pipeline-open", title: step.description, on: { click: () => choose(step) } },
      sign,
      element("span", { class: "pipeline-name" }, step.label),
      word,
      status,
    );
    const go = step.job ? button({
      label: `Run: ${step.label}`,
      icon: "play",
      bare: true,
      kind: "small",
      act: () => run(step),
    }) : null;
    const row = element("li", { class: "pipeline-step" }, open, go);
    list.append(row);
    rows.set(step, { row, open, sign, status, word, go });
  }
  const all = [
    button({
      label: "Automatic",
      kind: "small primary-quiet",
      icon: "wand",
      title: "Register automatically, from the images alone (the default)",
      act: () => requestForPhoto("run", { job: "auto" }),
    }),
    button({
      label: "Thesis chain",
      kind: "small",
      title: "Run all steps of the thesis in sequence",
      act: () => requestForPhoto("run", { job: "thesis" }),
    }),
  ];
  const part = element(
    "section",
    { class: "dock-part pipeline-part", "aria-label": title },
    element("div", { class: "part-head" }, element("h2", {}, title), element("div", { class: "end" }, ...all)),
    element("div", { class: "pipeline-body" }, list, pane),
  );

  const show = () => {
    const photo = store.shown();
    const job = store.get("job");
    const busy = isRunning(job);
    const context = {
      job: job?.photo === photo ? job : null,
      stages: store.posesOf()?.stages ?? [],
      corners: store.get(`corners:${photo}`),
      picks: store.picksOf(),
    };
    const missing = !store.get("scan") || !store.photo()?.camera;
    for (const [step, { row, open, sign, status, word, go }] of rows) {
      const { state, text } = step.job ? stepState(
        step,
        { ...context, last: finished.get(`${photo} ${step.job}`) ?? null },
      ) : { state: "none", text: "" };
      if (row.dataset.state !== state) setChildren(sign, icon(step.job ? ICONS[state] : "more"));
      row.dataset.state = state;
      sign.className = `sign ${LEVELS[state]}`;
      setText(status, text);
      status.title = text;
      setText(word, step.job ? `, ${STATES[state]}` : "");
      row.classList.toggle("chosen", step === chosen);
      setAttribute(open, "aria-current", step === chosen ? "true" : null);
      if (go) {
        go.disabled = busy || missing;
        go.title = missing
          ? "Needs a scan, and a photograph with a known focal length"
          : busy
          ? `${job.label} is running`
          : `Run: ${step.label}`;
      }
    }
    for (const control of all) control.disabled = busy || missing;
    const { row: chosenRow, status: chosenStatus } = rows.get(chosen);
    setText(failure, chosenRow.dataset.state === "failed" ? `Failed: ${chosenStatus.textContent}` : "");
    const entries = settingsOf(store.get("settings"), chosen);
    const shape = JSON.stringify([chosen.label, entries.map(([name, entry]) => [name, { ...entry, value: null }])]);
    if (shape !== drawn) {
      drawn = shape;
      form = settingsForm(entries);
      setChildren(
        pane,
        element("p", { class: "dim pipeline-about" }, chosen.description),
        failure,
        entries.length ? form.form : element("p", { class: "dim" }, "This step has no settings of its own."),
      );
    } else form?.show();
  };
  store.watch(["job", "settings", "poses:*", "corners:*", "picks:*", "shown", "scan", "photos"], show);
  show();
  return part;
};
