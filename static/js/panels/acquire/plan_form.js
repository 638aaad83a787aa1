/** The plan of a run: ranges and steps, the mount, what the run will be, and the plan as a file. */

import { ask } from "../../net/connection.js";
import { store } from "../../net/store.js";
import { changePlan, isActive, onPlan, planNow, setPlan } from "../../state/acquisition.js";
import { view } from "../../state/view.js";
import { button } from "../../ui/controls.js";
import { element, newId, setText } from "../../ui/dom.js";
import { notice } from "../../ui/notices.js";
import { throttled } from "../../ui/throttle.js";

const EVERY_MS = 250;
const FILE = "plan.json";

const duration = (seconds) =>
  seconds < 90 ? `${seconds} s` : seconds < 5400 ? `${Math.round(seconds / 60)} min` : `${(seconds / 3600).toFixed(1)} h`;

/** @returns {string} what a run will be, in words */
export const forecastText = (ahead) => {
  if (!ahead) return "";
  const count = (n, what) => `${n.toLocaleString("en")} ${what}${n === 1 ? "" : "s"}`;
  const parts = [count(ahead.stops, "stop")];
  if (ahead.pieces !== ahead.stops) parts.push(count(ahead.pieces, "piece"));
  if (ahead.cells) parts.push(`about ${count(ahead.cells, "cell")}`);
  if (ahead.overlap) parts.push(`overlap ${ahead.overlap.map((share) => `${Math.round(100 * share)} %`).join(" × ")}`);
  return `${parts.join(", ")}, about ${duration(ahead.seconds)}.`;
};

/** A row of numbers of one list in the plan. */
const numbersRow = (label, unit, names, read, write) => {
  const id = newId("plan");
  const inputs = names.map((name, k) => {
    const input = element("input", { type: "number", class: "number short", step: "any", "aria-label": `${label}, ${name}` });
    if (k === 0) input.id = id;
    input.addEventListener("change", () => {
      const values = [...(read(planNow()) ?? [])];
      values[k] = input.value.trim() === "" ? null : input.valueAsNumber;
      write(values);
    });
    return element("label", { class: "plan-number" }, element("span", { class: "dim" }, name), input);
  });
  const show = (plan) => {
    const values = read(plan) ?? [];
    for (const [k, each] of inputs.entries()) {
      const input = each.querySelector("input");
      if (document.activeElement !== input) input.value = values[k] ?? "";
    }
  };
  return { row: element("div", { class: "plan-row" }, element("label", { for: id }, label), ...inputs, element("span", { class: "dim" }, unit)), show };
};

/** @returns {HTMLElement} the panel */
export const mountPlanForm = () => {
  const rows = [
    numbersRow("Pan", "°", ["from", "to", "step"], (plan) => plan?.pan_deg, (pan_deg) => changePlan({ pan_deg })),
    numbersRow("Tilt", "°", ["from", "to", "step"], (plan) => plan?.tilt_deg, (tilt_deg) => changePlan({ tilt_deg })),
    numbersRow("Rest", "s", ["after a move"], (plan) => [plan?.settle_s], ([settle_s]) => changePlan({ settle_s })),
  ];
  const mountRows = [
    numbersRow("Position", "m", ["forward", "left", "up"], (plan) => plan?.mount?.xyz_m, (xyz_m) =>
      changePlan({ mount: { ...planNow().mount, xyz_m } })),
    numbersRow("Angles", "°", ["roll", "pitch", "yaw"], (plan) => plan?.mount?.rpy_deg, (rpy_deg) =>
      changePlan({ mount: { ...planNow().mount, rpy_deg } })),
  ];
  const steadily = element("input", { type: "checkbox" });
  steadily.addEventListener("change", () =>
    changePlan({ continuous: steadily.checked, passes: steadily.checked ? 2 : 1 }));
  const ahead = element("p", { class: "plan-ahead", role: "status" });
  const fault = element("p", { class: "form-wrong", role: "alert", hidden: true });
  const file = element("input", { type: "file", accept: ".json,application/json", hidden: true });
  file.addEventListener("change", async () => {
    const [chosen] = file.files;
    file.value = "";
    if (!chosen) return;
    try {
      const plan = JSON.parse(await chosen.text());
      if (plan === null || typeof plan !== "object" || Array.isArray(plan)) throw new Error("it is no object");
      setPlan(plan);
    } catch (error) {
      notice(`${chosen.name} is no plan: ${error.message}`, "bad");
    }
  });
  const save = () => {
    const url = URL.createObjectURL(new Blob([`${JSON.stringify(planNow(), null, 1)}\n`], { type: "application/json" }));
    element("a", { href: url, download: FILE }).click();
    setTimeout(() => URL.revokeObjectURL(url), 1000);
  };
  const form = element(
    "fieldset",
    { class: "plan-form" },
    element("legend", { class: "visually-hidden" }, "Plan"),
    ...rows.map(({ row }) => row),
    element("label", { class: "inline", title: "The unit turns steadily while lines are measured" }, steadily, "turn without stopping"),
    element(
      "details",
      { class: "plan-mount" },
      element("summary", {}, "Where the scanner is on the unit"),
      ...mountRows.map(({ row }) => row),
    ),
  );
  const part = element(
    "section",
    { class: "dock-part acquire-plan", "aria-label": "Plan" },
    element(
      "div",
      { class: "part-head" },
      element("h2", {}, "Plan"),
      element(
        "div",
        { class: "end edits" },
        button({ label: "Open a plan", text: "Open", kind: "small", act: () => file.click() }),
        button({ label: "Save the plan", text: "Save", kind: "small", act: save }),
        file,
      ),
    ),
    element("div", { class: "part-body" }, form, fault, ahead),
  );

  const check = throttled(async () => {
    if (view.get().step !== "acquire" || !planNow() || store.readOnly) return;
    let found;
    try {
      found = await ask("acquire_check", { plan: planNow() });
    } catch (error) {
      found = { fault: error.message, forecast: null };
    }
    fault.hidden = !found.fault;
    setText(fault, found.fault);
    setText(ahead, forecastText(found.forecast));
  }, EVERY_MS);

  const show = () => {
    const plan = planNow();
    for (const each of [...rows, ...mountRows]) each.show(plan);
    steadily.checked = Boolean(plan?.continuous);
    form.disabled = !plan || isActive() || store.readOnly;
    check();
  };
  onPlan(show);
  store.watch(["acquisition", "people"], show);
  view.on((_, changed) => changed.has("step") && show());
  show();
  return part;
};
