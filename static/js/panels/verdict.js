/** The verdict on the shown pose: accepted or not, six parameters with their sigmas, findings, and what to do next. */

import { button, element, put } from "../ui/dom.js";
import { icon } from "../ui/icons.js";
import { parameterName, sentences, typeset } from "../ui/numbers.js";
import { store } from "../net/store.js";
import { view } from "../state/view.js";
import { nextThing } from "../state/progress.js";

const LEVELS = { good: ["tick", "Good", "ok"], fair: ["warn", "Fair", "warn"], poor: ["bad", "Poor", "bad"] };
const EMPTY =
  "Once there is a pose, its verdict stands here: accepted or not and why, six parameters with their " +
  "uncertainty, and what would help.";
const WORST_FIRST = ["poor", "fair", "good"];

const head = (stage) => {
  const level = stage.accepted ? "ok" : "bad";
  const [first, ...rest] = (stage.verdict ?? "").split(/(?<=[.:]) /);
  return element(
    "div",
    { class: `verdict ${level}`, role: "status" },
    icon(stage.accepted ? "tick" : "bad"),
    element("p", {}, element("strong", {}, first), ` ${sentences(rest)}`, ` ${sentences(stage.reasons ?? [])}`),
  );
};

const six = (parameters) =>
  element(
    "dl",
    { class: "six" },
    ...parameters.map((parameter) =>
      element(
        "div",
        { class: "parameter" },
        element("dt", {}, parameterName(parameter)),
        element(
          "dd",
          { class: "figures" },
          typeset(parameter.value),
          element(
            "span",
            { class: "sigma" },
            parameter.sigma && parameter.sigma !== "unknown" ? `± ${parameter.sigma}` : "± ?",
          ),
        ),
      ),
    ),
  );

const finding = ({ level, sentence, what_to_do: advice }) => {
  const [sign, word, kind] = LEVELS[level] ?? LEVELS.fair;
  return element(
    "li",
    { class: `finding ${kind}` },
    element("span", { class: "sign" }, icon(sign), word),
    element("span", {}, sentences([sentence]), advice ? element("span", { class: "dim" }, ` ${advice}`) : null),
  );
};

const advices = (stage) =>
  (stage.advice ?? []).slice(0, 3).map(({ uv, sentence }) =>
    element(
      "li",
      { class: "advice" },
      element("span", {}, sentence),
      button({
        label: "Show",
        kind: "small",
        icon: "target",
        title: "Bring the place into sight in the photograph",
        act: () => view.set({ reveal_uv: { side: "photo", uv } }),
      }),
    ),
  );

const check = (stage) =>
  stage.check &&
  element(
    "li",
    { class: "advice" },
    element("span", {}, stage.check),
    stage.check_pick ? button({
      label: "Show",
      kind: "small",
      icon: "target",
      title: "Bring the match into sight",
      act: () => view.set({ selected: new Set([stage.check_pick]), end: null, reveal: stage.check_pick }),
    }) : null,
  );

/** @returns {HTMLElement} */
export const mountVerdict = () => {
  const body = element("div", { class: "part-body" });
  const staged = element("span", { class: "dim clip" });
  const part = element(
    "section",
    { class: "dock-part verdict-part", "aria-label": "Verdict" },
    element("div", { class: "part-head" }, element("h2", {}, "Verdict"), staged),
    body,
  );
  let drawn = "";
  const show = () => {
    const stage = store.stageOf();
    const judged = store.judgedOf();
    // a pose that was verified needs no method of the thesis any more
    const told = { losses: judged?.losses ?? [], cautions: stage?.evidence === "image" ? [] : judged?.cautions ?? [] };
    const [scan, photo] = [store.get("scan"), store.photo()];
    const next = stage || !store.picksOf().length ? "" : nextThing({ scan, photo, picks: store.picksOf(), poses: store.posesOf() });
    const text = JSON.stringify([stage, told, next]);
    if (text === drawn) return;
    drawn = text;
    put(staged, stage ? stage.label : "");
    if (!stage) {
      put(body, element("p", { class: "empty" }, EMPTY, element("strong", {}, next)), ...warnings(told));
      return;
    }
    const findings = (stage.findings ?? []).toSorted(
      (a, b) => WORST_FIRST.indexOf(a.level) - WORST_FIRST.indexOf(b.level),
    );
    put(
      body,
      head(stage),
      stage.note ? element("p", { class: "dim" }, stage.note) : null,
      stage.parameters?.length ? six(stage.parameters) : null,
      stage.uncertainty ? element("p", { class: "dim" }, stage.uncertainty) : null,
      element("ul", { class: "findings" }, ...advices(stage), check(stage), ...findings.map(finding)),
      ...warnings(told),
    );
  };
  store.watch(["poses:*", "judged:*", "shown", "scan", "photos", "picks:*"], show);
  show();
  return part;
};

const warning = (word) => (sentence) =>
  element(
    "li",
    { class: "finding warn" },
    element("span", { class: "sign" }, icon("warn"), word),
    element("span", {}, sentence),
  );

/** What was left out of the matches, and what hurts the thesis's own methods on them (thesis 3.4), before it does. */
const warnings = ({ losses, cautions }) =>
  losses.length + cautions.length
    ? [
        element(
          "ul",
          { class: "findings" },
          ...losses.map(warning("Left out")),
          ...cautions.map(warning("Thesis's methods")),
        ),
      ]
    : [];
