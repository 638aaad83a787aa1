/** Controls for settings, generated from their descriptions in slice `settings`. */

import { request } from "../../net/requests.js";
import { store } from "../../net/store.js";
import { element, newId } from "../../ui/dom.js";

/**
 * @typedef {import("../../protocol.d.ts").Setting} Setting
 * @typedef {(name: string, id: string, entry: Setting) => {control: HTMLElement, show: () => void}} MakeControl
 */

/** @param {string} name @param {string | number | boolean | null} value @param {() => void} show */
const set = async (name, value, show) => {
  if (value === store.get("settings")?.[name]?.value) return show();
  if (!(await request("set_settings", { [name]: value }))) show(); // refused: show the current value again
  return undefined;
};

/** @type {MakeControl} */
const numberControl = (name, id, entry) => {
  const input = element(
    "input",
    {
      id,
      type: "number",
      class: "number",
      min: entry.least,
      max: entry.most,
      step: "any",
      placeholder: entry.empty ? "auto" : null,
    },
  );
  const show = () => {
    const value = store.get("settings")?.[name]?.value;
    if (document.activeElement !== input) input.value = String(value ?? "");
  };
  input.addEventListener("change", () => {
    const value = input.value.trim() === "" ? null : input.valueAsNumber;
    if (value === null && !entry.empty) return show();
    return set(name, value, show);
  });
  input.addEventListener("keydown", (event) => {
    const up = event.key === "ArrowUp" ? 1 : event.key === "ArrowDown" ? -1 : 0;
    if (!up || !entry.step) return;
    event.preventDefault();
    const from = Number.isFinite(input.valueAsNumber) ? input.valueAsNumber : (entry.least ?? 0);
    const next = from + up * entry.step * (event.shiftKey ? 10 : 1);
    input.value = String(Number(Math.min(entry.most ?? next, Math.max(entry.least ?? next, next)).toPrecision(10)));
  });
  input.addEventListener("blur", () => requestAnimationFrame(show));
  return { control: input, show };
};

/** @type {MakeControl} */
const choiceControl = (name, id, entry) => {
  const select = element(
    "select",
    { id, class: "select" },
    ...entry.choices.map(({ value, label }) => element("option", { value }, label)),
  );
  const show = () => {
    select.value = String(store.get("settings")?.[name]?.value);
  };
  select.addEventListener("change", () => set(name, select.value, show));
  return { control: select, show };
};

/** @type {MakeControl} */
const switchControl = (name, id) => {
  const input = element("input", { id, type: "checkbox", class: "switch", role: "switch" });
  const show = () => {
    input.checked = Boolean(store.get("settings")?.[name]?.value);
  };
  input.addEventListener("change", () => set(name, input.checked, show));
  return { control: input, show };
};

/** @type {Record<string, MakeControl>} */
const CONTROLS = { number: numberControl, choice: choiceControl, switch: switchControl };

/**
 * @param {[string, Setting][]} entries names and entries of slice `settings`
 * @returns {{form: HTMLElement, show: () => void}} `show` updates the values
 */
export const settingsForm = (entries) => {
  const rows = entries.map(([name, entry]) => {
    const id = newId("setting");
    const description = newId("description");
    const { control, show } = (CONTROLS[entry.kind] ?? numberControl)(name, id, entry);
    control.setAttribute("aria-describedby", description);
    const row = element(
      "div",
      { class: "setting", title: entry.said },
      element("label", { for: id }, entry.label),
      control,
      element("span", { class: "dim" }, entry.unit ?? ""),
      element("span", { class: "visually-hidden", id: description }, entry.said ?? ""),
    );
    return { row, show };
  });
  const show = () => rows.forEach((each) => each.show());
  show();
  return { form: element("div", { class: "settings" }, ...rows.map(({ row }) => row)), show };
};
