/** The thesis's steps in order, each with its button, how it stands and its settings. */

import { CHAIN, OTHERS, runs, settingsOf, stepState } from "../state/pipeline.js";
import { attribute, button, element, put, say } from "../ui/dom.js";
import { wishHere } from "../net/requests.js";
import { icon } from "../ui/icons.js";
import { settingsForm } from "./settings_form.js";
import { store } from "../net/store.js";

const SIGNS = { none: "dot", running: "running", paused: "pause", done: "tick", failed: "bad", stopped: "stop" };
const LEVELS = { none: "dim", running: "accent", paused: "warn", done: "ok", failed: "bad", stopped: "warn" };
const WORDS = {
  none: "not run",
  running: "running",
  paused: "paused",
  done: "done",
  failed: "failed",
  stopped: "stopped",
};

/** The newest finished job of each kind and photograph: slice `job` holds only the last one of all. */
const finished = new Map();
store.on("job", (job) => {
  if (job && !runs(job)) finished.set(`${job.photo} ${job.kind}`, job);
});

/**
 * @param {"match" | "solve" | "all"} which steps are shown
 * @param {string} title
 * @returns {HTMLElement}
 */
export const mountChain = (which, title) => {
  const steps = CHAIN.filter((step) => which === "all" || step.in === which);
  let chosen = steps[0];
  let drawn = "";
  let form = null;
  const list = element("ol", { class: "chain", "aria-label": title });
  const pane = element("div", { class: "chain-settings" });
  const failure = element("p", { class: "bad chain-failure", role: "status" });
  const rows = new Map();

  const run = (step) => {
    choose(step);
    wishHere("run", { job: step.job });
  };
  const choose = (step) => {
    chosen = step;
    show();
  };
  for (const step of [...steps, OTHERS]) {
    const sign = element("span", { class: "sign" });
    const said = element("span", { class: "clip dim chain-said" });
    const word = element("span", { class: "told" });
    const open = element(
      "button",
      { type: "button", class: "chain-open", title: step.said, on: { click: () => choose(step) } },
      sign,
      element("span", { class: "chain-name" }, step.label),
      word,
      said,
    );
    const go = step.job ? button({
      label: `Run: ${step.label}`,
      icon: "play",
      bare: true,
      kind: "small",
      act: () => run(step),
    }) : null;
    const row = element("li", { class: "chain-step" }, open, go);
    list.append(row);
    rows.set(step, { row, open, sign, said, word, go });
  }
  const all = [
    button({
      label: "All in one",
      kind: "small primary-quiet",
      icon: "wand",
      title: "Register automatically: the default, from the pictures alone",
      act: () => wishHere("run", { job: "auto" }),
    }),
    button({
      label: "Thesis chain",
      kind: "small",
      title: "All steps of the thesis, one after the other",
      act: () => wishHere("run", { job: "thesis" }),
    }),
  ];
  const part = element(
    "section",
    { class: "dock-part chain-part", "aria-label": title },
    element("div", { class: "part-head" }, element("h2", {}, title), element("div", { class: "end" }, ...all)),
    element("div", { class: "chain-body" }, list, pane),
  );

  const show = () => {
    const photo = store.shown();
    const job = store.get("job");
    const busy = runs(job);
    const context = {
      job: job?.photo === photo ? job : null,
      stages: store.posesOf()?.stages ?? [],
      corners: store.get(`corners:${photo}`),
      picks: store.picksOf(),
    };
    const missing = !store.get("scan") || !store.photo()?.camera;
    for (const [step, { row, open, sign, said, word, go }] of rows) {
      const { state, said: text } = step.job ? stepState(
        step,
        { ...context, last: finished.get(`${photo} ${step.job}`) ?? null },
      ) : { state: "none", said: "" };
      if (row.dataset.state !== state) put(sign, icon(step.job ? SIGNS[state] : "more"));
      row.dataset.state = state;
      sign.className = `sign ${LEVELS[state]}`;
      say(said, text);
      said.title = text;
      say(word, step.job ? `, ${WORDS[state]}` : "");
      row.classList.toggle("chosen", step === chosen);
      attribute(open, "aria-current", step === chosen ? "true" : null);
      if (go) {
        go.disabled = busy || missing;
        go.title = missing
          ? "Needs a scan and a photograph whose focal length is known"
          : busy
          ? `${job.label} is running`
          : `Run: ${step.label}`;
      }
    }
    for (const made of all) made.disabled = busy || missing;
    const { row: chosenRow, said: chosenSaid } = rows.get(chosen);
    say(failure, chosenRow.dataset.state === "failed" ? `Failed: ${chosenSaid.textContent}` : "");
    const entries = settingsOf(store.get("settings"), chosen);
    const shape = JSON.stringify([chosen.label, entries.map(([name, { value, ...rest }]) => [name, rest])]);
    if (shape !== drawn) {
      drawn = shape;
      form = settingsForm(entries);
      put(
        pane,
        element("p", { class: "dim chain-about" }, chosen.said),
        failure,
        entries.length ? form.form : element("p", { class: "dim" }, "It has no settings of its own."),
      );
    } else form?.show();
  };
  store.watch(["job", "settings", "poses:*", "corners:*", "picks:*", "shown", "scan", "photos"], show);
  show();
  return part;
};
