/** Rows of a plan's form: numbers, choices and texts, each with the faults of its own fields below it. */

import { onFaults } from "../../state/acquisition.js";
import { element, newId, setText } from "../../ui/dom.js";

/** @typedef {import("../../state/acquisition.js").Plan} Plan */

/**
 * Give a row the line below it that says what is wrong with its fields.
 * @param {HTMLElement} row
 * @param {string[]} fields names as in plan.json, such as `pan_deg` or `scanner.folder`; a part's name takes all of it
 * @returns {HTMLElement} the row with its line
 */
export const withFaults = (row, fields) => {
  const id = newId("plan-wrong");
  const line = element("p", { class: "form-wrong plan-wrong", role: "alert", id, hidden: true });
  onFaults((faults) => {
    const own = faults.filter(({ field }) => fields.some((name) => field === name || field.startsWith(`${name}.`)));
    line.hidden = own.length === 0;
    setText(line, own.map(({ said }) => said).join("; "));
    for (const input of row.querySelectorAll("input, select")) {
      input.setAttribute("aria-invalid", String(own.length > 0));
      if (own.length) input.setAttribute("aria-describedby", id);
      else input.removeAttribute("aria-describedby");
    }
  });
  return element("div", { class: "plan-field" }, row, line);
};

/**
 * A row of numbers.
 * @param {{label: string, unit: string, names: string[], fields: string[], read: (plan: Plan | null) => (number | null | undefined)[] | null | undefined,
 *   write: (values: (number | null)[]) => void}} options `names` of the numbers; `fields` as for `withFaults`
 * @returns {{row: HTMLElement, show: (plan: Plan | null) => void}}
 */
export const numbersRow = ({ label, unit, names, fields, read, write }) => {
  const id = newId("plan");
  /** @type {Plan | null} */
  let shown = null;
  const inputs = names.map((name, k) => {
    const input = element("input", { type: "number", class: "number short", step: "any", "aria-label": `${label}, ${name}` });
    if (k === 0) input.id = id;
    input.addEventListener("change", () => {
      const values = names.map((_, n) => read(shown)?.[n] ?? null);
      values[k] = input.value.trim() === "" ? null : input.valueAsNumber;
      write(values);
    });
    return input;
  });
  const show = (/** @type {Plan | null} */ plan) => {
    shown = plan;
    const values = read(plan) ?? [];
    for (const [k, input] of inputs.entries()) {
      if (document.activeElement !== input) input.value = String(values[k] ?? "");
    }
  };
  const row = element(
    "div",
    { class: "plan-row" },
    element("label", { for: id }, label),
    ...inputs.map((input, k) => element("label", { class: "plan-number" }, element("span", { class: "dim" }, names[k]), input)),
    element("span", { class: "dim" }, unit),
  );
  return { row: withFaults(row, fields), show };
};

/**
 * A row with a text.
 * @param {{label: string, hint: string, fields: string[], read: (plan: Plan | null) => string | undefined, write: (text: string) => void}} options
 * @returns {{row: HTMLElement, show: (plan: Plan | null) => void}}
 */
export const textRow = ({ label, hint, fields, read, write }) => {
  const input = element("input", { type: "text", class: "text", placeholder: hint, spellcheck: false, autocomplete: "off" });
  input.addEventListener("change", () => write(input.value.trim()));
  const show = (/** @type {Plan | null} */ plan) => {
    if (document.activeElement !== input) input.value = read(plan) ?? "";
  };
  return { row: withFaults(element("label", { class: "plan-choice" }, element("span", {}, label), input), fields), show };
};
