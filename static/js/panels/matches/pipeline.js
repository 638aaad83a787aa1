/** The methods: matching and solving, and all steps of the thesis in order, each with its state and its settings. */

import { requestForPhoto } from "../../net/requests.js";
import { store } from "../../net/store.js";
import { GENERAL, isRunning, jobOn, PIPELINE, settingsOf, stepState } from "../../state/pipeline.js";
import { button } from "../../ui/controls.js";
import { element, newId, setAttribute, setChildren, setText } from "../../ui/dom.js";
import { icon } from "../../ui/icons.js";
import { settingsForm } from "./settings_form.js";

/** @type {Record<string, [string, string, string]>} icon, level and word of each state */
const LOOKS = {
  none: ["dot", "dim", "not run"],
  running: ["running", "accent", "running"],
  paused: ["pause", "warn", "paused"],
  done: ["tick", "ok", "done"],
  solved: ["target", "accent", "done, not accepted"],
  failed: ["bad", "bad", "failed"],
  stopped: ["stop", "warn", "stopped"],
  stale: ["warn", "warn", "out of date"],
  unclear: ["warn", "warn", "undecidable"],
};

/**
 * The newest finished job of each kind and photograph; slice `job` contains only the last one of all.
 * @type {Map<string, import("../../net/store.js").Job>}
 */
const finished = new Map();
store.on("job", (job) => {
  if (job && !isRunning(job)) finished.set(`${job.photo} ${job.kind}`, job);
});

/** @typedef {import("../../state/pipeline.js").PipelineStep} PipelineStep */

const ALL_KEY = "ladarreg-all-steps";
const MAIN = PIPELINE.filter(({ main }) => main);

const remembered = () => {
  try {
    return localStorage.getItem(ALL_KEY) === "shown";
  } catch {
    return false; // storage is disabled
  }
};

/** @param {boolean} all */
const remember = (all) => {
  try {
    localStorage.setItem(ALL_KEY, all ? "shown" : "hidden");
  } catch {
    // storage is disabled: the choice holds for this visit
  }
};

/** @returns {HTMLElement} */
export const mountPipeline = () => {
  let all = remembered();
  let [chosen] = MAIN;
  let drawn = "";
  /** @type {ReturnType<typeof settingsForm> | null} */
  let form = null;
  const list = element("ol", { class: "pipeline", id: newId("steps"), "aria-label": "Steps" });
  const pane = element("div", { class: "pipeline-settings" });
  const failure = element("p", { class: "bad pipeline-failure", role: "status" });

  const run = (/** @type {PipelineStep} */ step) => {
    choose(step);
    requestForPhoto("run", { job: step.job });
  };
  const choose = (/** @type {PipelineStep} */ step) => {
    chosen = step;
    show();
  };
  const rows = [...PIPELINE, GENERAL].map((step) => {
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
      kind: "small edits",
      act: () => run(step),
    }) : null;
    const row = element("li", { class: "pipeline-step" }, open, go);
    list.append(row);
    return { step, row, open, sign, status, word, go };
  });
  const chain = button({
    label: "Thesis chain",
    kind: "small plain edits",
    title: "Run all steps of the thesis in sequence, on matches that it finds itself",
    act: () => requestForPhoto("run", { job: "thesis" }),
  });
  const solve = button({
    label: "Solve from matches",
    kind: "small primary-quiet edits",
    icon: "play",
    title: "Solve robustly from the enabled matches, and verify the pose against the images",
    act: () => requestForPhoto("run", { job: "solve" }),
  });
  const more = button({
    label: "All steps",
    kind: "small plain",
    icon: "more",
    title: "Every step of the thesis by itself, in its order",
    "aria-controls": list.id,
    act: () => {
      all = !all;
      remember(all);
      if (!all && !chosen.main) [chosen] = MAIN;
      show();
    },
  });
  const group = element("div", { class: "pipeline-group" }, more, chain);
  const part = element(
    "section",
    { class: "dock-part pipeline-part", "aria-label": "Methods" },
    element("div", { class: "part-head" }, element("h2", {}, "Methods"), element("div", { class: "end" }, solve)),
    element(
      "div",
      { class: "pipeline-body" },
      element("div", { class: "pipeline-side" }, list, group),
      pane,
    ),
  );

  const show = () => {
    const photo = store.shown();
    const job = store.get("job");
    const blocking = jobOn(job, photo);
    const busy = blocking !== null;
    const context = {
      job: job?.photo === photo ? job : null,
      stages: store.posesOf()?.stages ?? [],
      shown: store.stageOf(),
      corners: store.get(`corners:${photo}`),
      picks: store.picksOf(),
    };
    const missing = !store.get("scan") || !store.photo()?.camera;
    let wrong = "";
    for (const { step, row, open, sign, status, word, go } of rows) {
      const { state, text } = step.job ? stepState(
        step,
        { ...context, last: finished.get(`${photo} ${step.job}`) ?? null },
      ) : { state: "none", text: "" };
      const [shape, level, said] = LOOKS[state];
      if (row.dataset.state !== state) setChildren(sign, icon(step.job ? shape : "more"));
      row.dataset.state = state;
      sign.className = `sign ${level}`;
      setText(status, text);
      status.title = text;
      setText(word, step.job ? `, ${said}` : "");
      if (step === chosen) {
        wrong = state === "failed" || state === "unclear" ? text : "";
        failure.classList.toggle("bad", state === "failed");
        failure.classList.toggle("warn", state === "unclear");
      }
      row.hidden = !all && !step.main;
      row.classList.toggle("chosen", step === chosen);
      setAttribute(open, "aria-current", step === chosen ? "true" : null);
      if (go) {
        go.disabled = busy || missing;
        go.title = missing
          ? "Needs a scan, and a photograph with a known focal length"
          : busy
          ? `${blocking.label} is ${"state" in blocking ? "running" : "waiting"}`
          : `Run: ${step.label}`;
      }
    }
    more.setAttribute("aria-expanded", String(all));
    chain.hidden = !all;
    for (const control of [solve, chain]) control.disabled = busy || missing;
    solve.disabled ||= !context.picks.some(({ on }) => on);
    setText(failure, wrong);
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
