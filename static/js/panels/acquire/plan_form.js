/** The plan of a run: ranges and steps, the mount, what the run will be, and the plan as a file. */

import { ask } from "../../net/connection.js";
import { store } from "../../net/store.js";
import { changePlan, isActive, onPlan, planNow, setFaults, setPlan } from "../../state/acquisition.js";
import { view } from "../../state/view.js";
import { button, fill } from "../../ui/controls.js";
import { element, setText } from "../../ui/dom.js";
import { messageOf } from "../../ui/faults.js";
import { notice } from "../../ui/notices.js";
import { throttled } from "../../ui/throttle.js";
import { numbersRow, withFaults } from "./plan_rows.js";

const EVERY_MS = 250;
const FILE = "plan.json";
const PLACED = /^(pan_deg|tilt_deg|settle_s|continuous|passes|mount\.(xyz_m|rpy_deg|base)|unit(\..+)?|scanner\.(?!$).+|camera(\..+)?)$/;
/** Fields whose faults stand beside them, here or among the devices; all others are said below the form. */

/** @param {number} seconds */
const duration = (seconds) =>
  seconds < 90 ? `${seconds} s` : seconds < 5400 ? `${Math.round(seconds / 60)} min` : `${(seconds / 3600).toFixed(1)} h`;

/**
 * @param {{stops: number, pieces: number, cells?: number, overlap?: number[] | null, seconds: number} | null} ahead
 * @returns {string} what a run will be, in words
 */
export const forecastText = (ahead) => {
  if (!ahead) return "";
  const count = (/** @type {number} */ n, /** @type {string} */ what) => `${n.toLocaleString("en")} ${what}${n === 1 ? "" : "s"}`;
  const parts = [count(ahead.stops, "stop")];
  if (ahead.pieces !== ahead.stops) parts.push(count(ahead.pieces, "piece"));
  if (ahead.cells) parts.push(`about ${count(ahead.cells, "cell")}`);
  if (ahead.overlap) parts.push(`overlap ${ahead.overlap.map((share) => `${Math.round(100 * share)} %`).join(" × ")}`);
  return `${parts.join(", ")}, about ${duration(ahead.seconds)}.`;
};

/** @returns {HTMLElement} the panel */
export const mountPlanForm = () => {
  const rows = [
    numbersRow({
      label: "Pan", unit: "°", names: ["from", "to", "step"], fields: ["pan_deg"],
      read: (plan) => plan?.pan_deg, write: (pan_deg) => changePlan({ pan_deg }),
    }),
    numbersRow({
      label: "Tilt", unit: "°", names: ["from", "to", "step"], fields: ["tilt_deg"],
      read: (plan) => plan?.tilt_deg, write: (tilt_deg) => changePlan({ tilt_deg }),
    }),
    numbersRow({
      label: "Rest", unit: "s", names: ["after a move"], fields: ["settle_s"],
      read: (plan) => [plan?.settle_s], write: ([settle_s]) => changePlan({ settle_s }),
    }),
  ];
  const mountRows = [
    numbersRow({
      label: "Position", unit: "m", names: ["forward", "left", "up"], fields: ["mount.xyz_m"],
      read: (plan) => plan?.mount?.xyz_m, write: (xyz_m) => changePlan({ mount: { ...planNow()?.mount, xyz_m } }),
    }),
    numbersRow({
      label: "Angles", unit: "°", names: ["roll", "pitch", "yaw"], fields: ["mount.rpy_deg"],
      read: (plan) => plan?.mount?.rpy_deg, write: (rpy_deg) => changePlan({ mount: { ...planNow()?.mount, rpy_deg } }),
    }),
  ];
  const base = element("select", { class: "select small", "aria-label": "How the unit stands" });
  base.addEventListener("change", () => {
    const { base: former, ...mount } = planNow()?.mount ?? {};
    changePlan({ mount: base.value === "upright" ? mount : { ...mount, base: base.value === "hanging" ? "hanging" : former } });
  });
  const showBase = (/** @type {import("../../state/acquisition.js").Plan | null} */ plan) => {
    const stated = plan?.mount?.base ?? "upright";
    /** @type {[string, string][]} */
    const leans = Array.isArray(stated) ? [["leaning", `leaning: ${stated.join(", ")}°`]] : [];
    fill(base, [["upright", "stands upright"], ["hanging", "hangs"], ...leans], Array.isArray(stated) ? "leaning" : stated);
  };
  const steadily = element("input", { type: "checkbox" });
  steadily.addEventListener("change", () =>
    changePlan({ continuous: steadily.checked, passes: steadily.checked ? 2 : 1 }));
  const mountPart = element(
    "details",
    { class: "plan-mount" },
    element("summary", {}, "Where the scanner is on the unit, and how that stands"),
    ...mountRows.map(({ row }) => row),
    withFaults(
      element("label", { class: "inline", title: "Panoramas are level. A unit that leans is stated in the plan's file: mount.base" }, "The unit", base),
      ["mount.base"],
    ),
  );
  const ahead = element("p", { class: "plan-ahead", role: "status" });
  const fault = element("p", { class: "form-wrong", role: "alert", hidden: true });
  const file = element("input", { type: "file", accept: ".json,application/json", hidden: true });
  file.addEventListener("change", async () => {
    const chosen = file.files?.[0];
    file.value = "";
    if (!chosen) return;
    try {
      const plan = JSON.parse(await chosen.text());
      if (plan === null || typeof plan !== "object" || Array.isArray(plan)) throw new Error("it is no object");
      setPlan(plan);
    } catch (error) {
      notice(`${chosen.name} is no plan: ${messageOf(error)}`, "bad");
    }
  });
  const save = () => {
    const url = URL.createObjectURL(new Blob([`${JSON.stringify(planNow(), null, 1)}\n`], { type: "application/json" }));
    element("a", { href: url, download: FILE }).click();
    setTimeout(() => URL.revokeObjectURL(url), 1000);
  };
  const sweeping = element(
    "label",
    { class: "inline", title: "The unit turns steadily while lines are measured" },
    steadily,
    "turn without stopping",
  );
  const form = element(
    "fieldset",
    { class: "plan-form" },
    element("legend", { class: "visually-hidden" }, "Plan"),
    ...rows.map(({ row }) => row),
    withFaults(sweeping, ["continuous", "passes"]),
    mountPart,
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
    const plan = planNow();
    if (view.get().step !== "acquire" || !plan || store.readOnly) return;
    let found;
    try {
      found = await ask("acquire_check", { plan });
    } catch (error) {
      found = { faults: [{ field: "", said: messageOf(error) }], forecast: null };
    }
    /** @type {import("../../state/acquisition.js").PlanFault[]} */
    const faults = found.faults;
    setFaults(faults);
    const elsewhere = faults.filter(({ field }) => !PLACED.test(field));
    fault.hidden = elsewhere.length === 0;
    setText(fault, elsewhere.map(({ said }) => said).join("; "));
    mountPart.open ||= faults.some(({ field }) => field.startsWith("mount."));
    setText(ahead, forecastText(found.forecast));
  }, EVERY_MS);

  const show = () => {
    const plan = planNow();
    for (const each of [...rows, ...mountRows]) each.show(plan);
    showBase(plan);
    steadily.checked = Boolean(plan?.continuous);
    sweeping.hidden = plan?.mode === "mosaic";
    form.disabled = !plan || isActive() || store.readOnly;
    check();
  };
  onPlan(show);
  store.watch(["acquisition", "people"], show);
  view.on((_, changed) => changed.has("step") && show());
  show();
  return part;
};
