/** The verdict on the shown pose: accepted or not, parameters with standard deviations, findings and suggestions. */

import { requestForPhoto } from "../../net/requests.js";
import { store } from "../../net/store.js";
import { jobOn } from "../../state/pipeline.js";
import { progressNow } from "../../state/progress.js";
import { view } from "../../state/view.js";
import { button } from "../../ui/controls.js";
import { element, setChildren } from "../../ui/dom.js";
import { icon } from "../../ui/icons.js";
import { lightOf } from "../../ui/lights.js";
import { parameterName, sentences, typeset } from "../../ui/numbers.js";
import { openFiles } from "../files/files.js";
import { ABOUT_FRAMES } from "../files/scan_clouds.js";
import { mountSmoothing } from "./smoothing.js";

const FROM_IMAGES = new Set(["auto", "survey", "carried"]);
/**
 * @typedef {import("../../net/store.js").Stage} Stage
 * @typedef {import("../../protocol.d.ts").Finding} Finding
 */

/** @type {Record<string, [string, string, string]>} sign, word and CSS class */
const LEVELS = { good: ["tick", "Good", "ok"], fair: ["warn", "Fair", "warn"], poor: ["bad", "Poor", "bad"] };
const EMPTY =
  "Once there is a pose, its verdict is shown here: accepted or not, with reasons, six parameters with their " +
  "uncertainty, and suggestions.";

/** Solving from the matches, where a verdict is missing or out of date. @param {boolean} enabled */
const solveButton = (enabled) =>
  button({
    label: "Solve from matches",
    kind: "small edits",
    icon: "play",
    title: "Solve robustly from the enabled matches, and refine the pose against the image",
    disabled: !enabled,
    act: () => requestForPhoto("run", { job: "solve" }),
  });

/** Finding the pose in the images alone. @param {boolean} enabled */
const registerButton = (enabled) =>
  button({
    label: "Register automatically",
    kind: "small edits",
    icon: "play",
    title: "Find the pose from the images alone; drawn matches are not changed",
    disabled: !enabled,
    act: () => requestForPhoto("run", { job: "auto" }),
  });

/** Asking the images, where a pose rests on its matches alone. @param {boolean} enabled */
const verifyButton = (enabled) =>
  button({
    label: "Verify",
    kind: "small edits",
    icon: "play",
    title: "Verify the shown pose against the images",
    disabled: !enabled,
    act: () => requestForPhoto("run", { job: "verify" }),
  });

/** Where the reasons advise to accumulate longer. */
const framesButton = () =>
  button({
    label: "Add frames",
    kind: "small edits",
    icon: "plus",
    title: `Add ${ABOUT_FRAMES}`,
    act: () => openFiles("frames"),
  });

const exportButton = () =>
  button({ label: "Export", kind: "small", icon: "download", title: "Open the step Export", act: () => view.set({ step: "export" }) });

/** @param {string} label @param {string} stage @param {string} kind */
const stageButton = (label, stage, kind) =>
  button({ label, kind: `small edits ${kind}`, act: () => requestForPhoto("use_stage", { stage }) });

/** @type {Record<string, (next: import("../../protocol.d.ts").NextStep, enabled: boolean) => HTMLElement | null>} the button of a next step */
const ACTIONS = {
  solve: (_, enabled) => solveButton(enabled),
  verify: (_, enabled) => verifyButton(enabled),
  register: (_, enabled) => registerButton(enabled),
  frames: () => framesButton(),
  export: () => exportButton(),
  use_stage: ({ stage }) => (stage === null ? null : stageButton("Use the images' pose", stage, "primary")),
};

/** @param {string} value @param {string} name @param {string} title */
const figure = (value, name, title) =>
  value ? element("div", { class: "verdict-figure", title }, element("strong", { class: "figures" }, value), element("span", {}, name)) : null;

/**
 * One line with its light, two figures, and the next step.
 * @param {Stage} stage
 * @param {{busy: boolean, lacks: string, solving: boolean, why: string}} now
 */
const head = (stage, { busy, lacks, solving, why }) => {
  const { light, line, position, pixels, next_step: next, other } = stage.summary;
  const { sign, level } = lightOf(light);
  const waits = light === "out_of_date" && (solving ? "Solving after the last edit." : lacks || why);
  const act = waits && (solving || lacks) ? null : ACTIONS[next.action]?.(next, !busy);
  return element(
    "div",
    { class: `verdict ${level}`, role: "status" },
    icon(sign),
    element(
      "div",
      { class: "verdict-lines" },
      element("p", { class: "verdict-line" }, element("strong", {}, line)),
      element(
        "div",
        { class: "verdict-figures" },
        figure(position, "position, 1 σ", "Standard deviation of the camera's position"),
        figure(pixels, "pixels, median 1 σ", "Median standard deviation of the photograph's pixels on the scan"),
        stage.summary.matches ? element("span", { class: "dim verdict-count" }, stage.summary.matches) : null,
      ),
      element("p", { class: "verdict-next" }, waits || next.sentence, " ", act, " ",
        other?.stage ? stageButton(other.sentence, other.stage, "plain") : null),
    ),
  );
};

/** @param {{name: string, unit: string, value: string, sigma?: string}[]} parameters */
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

const finding = (/** @type {string} */ stale) => (/** @type {Finding} */ { level, sentence, what_to_do: advice }) => {
  const [sign, word, kind] = stale ? ["dot", "Before", "dim"] : (LEVELS[level] ?? LEVELS.fair);
  return element(
    "li",
    { class: `finding ${kind}` },
    element("span", { class: "sign" }, icon(sign), word),
    element("span", {}, sentences([sentence]), advice ? element("span", { class: "dim" }, ` ${advice}`) : null),
  );
};

/** @param {{uv: number[], sentence: string}[]} [advice] */
const advices = (advice = []) =>
  advice.slice(0, 3).map(({ uv, sentence }) =>
    element(
      "li",
      { class: "advice" },
      element("span", {}, sentence),
      button({
        label: "Show",
        kind: "small",
        icon: "target",
        title: "Show this point in the photograph",
        act: () => view.set({ reveal_uv: { side: "photo", uv } }),
      }),
    ),
  );

/** @param {Stage} stage */
const check = ({ check: sentence, check_pick: pick }) =>
  sentence &&
  element(
    "li",
    { class: "advice" },
    element("span", {}, sentence),
    pick ? button({
      label: "Show",
      kind: "small",
      icon: "target",
      title: "Show this match in the pictures",
      act: () => view.set({ selected: new Set([pick]), end: null, reveal: pick }),
    }) : null,
  );

/** @returns {HTMLElement} */
export const mountVerdict = () => {
  const body = element("div", {});
  const stageLabel = element("span", { class: "dim clip" });
  const smoothing = mountSmoothing();
  const part = element(
    "section",
    { class: "dock-part verdict-part", "aria-label": "Verdict" },
    element("div", { class: "part-head" }, element("h2", {}, "Verdict"), stageLabel, element("div", { class: "end" }, smoothing.opener)),
    element("div", { class: "part-body" }, smoothing.section, body),
  );
  let drawn = "";
  let unfolded = false;
  const show = () => {
    const stage = store.stageOf();
    const judged = store.judgedOf();
    // for a verified pose the limits of the thesis's methods do not matter
    const limits = { losses: judged?.losses ?? [], cautions: stage?.evidence === "image" ? [] : judged?.cautions ?? [] };
    const [scan, photo] = [store.get("scan"), store.photo()];
    const progress = progressNow();
    const next = stage || !store.picksOf().length ? "" : progress.next_action;
    const busy = Boolean(jobOn(store.get("job"), store.shown()));
    const missing = progress.needed;
    const automatic = store.get(`solving:${store.shown()}`);
    const solving = Boolean(automatic?.busy);
    const why = automatic?.sentence ?? "";
    const solvable = Boolean(scan && photo?.camera) && !missing;
    const text = JSON.stringify([stage, limits, next, busy, missing, solvable, solving, why]);
    if (text === drawn) return;
    drawn = text;
    setChildren(stageLabel, stage ? stage.label : "");
    if (!stage) {
      setChildren(
        body,
        element("p", { class: "empty" }, EMPTY, element("strong", {}, next)),
        why ? element("p", { class: "empty" }, `Not solved: ${why}`) : null,
        solving ? element("p", { class: "empty" }, "Solving after the last edit.") : null,
        solvable && !solving ? solveButton(!busy) : null,
        ...warnings(limits),
      );
      return;
    }
    const evidence = element(
      "details",
      { class: "evidence", open: unfolded },
      element("summary", {}, "Evidence and parameters"),
      stage.stale ? element("p", { class: "dim" }, sentences([stage.verdict])) : null,
      stage.reasons?.length ? element("p", {}, sentences(stage.reasons)) : null,
      stage.note ? element("p", { class: "dim" }, stage.note) : null,
      stage.parameters?.length ? six(stage.parameters) : null,
      stage.in_world ? element("p", { class: "dim" }, `In the world: ${stage.in_world}.`) : null,
      stage.uncertainty ? element("p", { class: "dim" }, stage.uncertainty) : null,
      element("ul", { class: "findings" }, ...advices(stage.advice), check(stage), ...(stage.findings ?? []).map(finding(stage.stale))),
      ...warnings(limits),
    );
    evidence.addEventListener("toggle", () => (unfolded = evidence.open));
    setChildren(body, head(stage, { busy, lacks: stage.stale && !FROM_IMAGES.has(stage.stage) ? missing : "", solving, why }), evidence);
  };
  store.watch(["poses:*", "judged:*", "shown", "scan", "photos", "picks:*", "job", "solving:*", "progress:*"], show);
  show();
  return part;
};

const warning = (/** @type {string} */ word) => (/** @type {string} */ sentence) =>
  element(
    "li",
    { class: "finding warn" },
    element("span", { class: "sign" }, icon("warn"), word),
    element("span", {}, sentence),
  );

/**
 * Warnings: excluded matches, and limits of the thesis's methods with these matches (thesis 3.4).
 * @param {{losses: string[], cautions: string[]}} limits
 */
const warnings = ({ losses, cautions }) =>
  losses.length + cautions.length
    ? [
        element(
          "ul",
          { class: "findings" },
          ...losses.map(warning("Excluded")),
          ...cautions.map(warning("Thesis methods")),
        ),
      ]
    : [];
