/** The form for what a file does not say itself: where the scanner stood, the unit of temperatures, and so on. */

import { store } from "../../net/store.js";
import { element, newId, setText } from "../../ui/dom.js";

/** @param {string} text */
const numberOf = (text) => (text.trim() === "" ? Number.NaN : Number(text));

/** @type {Record<string, string>} */
const UNITS = { k: "K", c: "C", none: "none" };

/** @type {Record<string, (text: string) => unknown>} what was typed, by the kind of a field; null if that is wrong */
const READ = {
  whole: (text) => (/^\d+$/u.test(text) ? Number(text) : null),
  coordinates: (text) => {
    const values = text.split(/[\s,;]+/u).map(numberOf);
    return values.length === 3 && values.every(Number.isFinite) ? values : null;
  },
  names: (text) => text.split(/[\s,;]+/u),
  text: (text) => text,
  duration: (text) => (numberOf(text) > 0 ? numberOf(text) : null),
  temperature_unit: (text) => UNITS[text.toLowerCase().replace(/°|deg\s*/u, "")] ?? null,
};

/**
 * @param {string[]} takes names of the options that the file's reader takes
 * @param {(reading: Record<string, unknown>) => void} submit receives the options that were filled in
 * @param {string[]} [scans] descriptions of the file's scans, if it contains several
 * @returns {HTMLFormElement}
 */
export const readingForm = (takes, submit, scans = []) => {
  const fields = store.get("reading") ?? {};
  /** @type {Map<string, HTMLInputElement | HTMLSelectElement>} */
  const inputs = new Map();
  const rows = takes
    .filter((name) => fields[name]?.kind in READ)
    .map((name) => {
      const { label, hint, example } = fields[name];
      const id = newId("reading");
      const isChoice = name === "scan_index" && scans.length > 0;
      const input = isChoice
        ? element("select", { id }, ...scans.map((scan, index) => element("option", { value: String(index) }, scan)))
        : element("input", { id, type: "text", autocomplete: "off", placeholder: example });
      inputs.set(name, input);
      return element(
        "div",
        { class: "field" },
        element("label", { for: id }, label),
        input,
        isChoice ? null : element("span", { class: "dim" }, hint),
      );
    });
  const luma = element("input", { type: "checkbox" });
  const act = inputs.has("temperature_unit") || inputs.has("camera_name") ? "Open" : "Open as scan";
  const wrong = element("p", { class: "form-wrong", role: "alert", hidden: true });
  const form = element(
    "form",
    { class: "reading-form", noValidate: true },
    ...rows,
    takes.includes("intensity") && fields.intensity
      ? element("label", { class: "row" }, luma, fields.intensity.label)
      : null,
    wrong,
    element("div", { class: "form-foot" }, element("button", { class: "button primary edits", type: "submit" }, act)),
  );
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    /** @type {Record<string, unknown>} */
    const reading = luma.checked ? { intensity: "luma" } : {};
    wrong.hidden = true;
    for (const [name, input] of inputs) {
      const text = input.value.trim();
      const value = text === "" ? undefined : READ[fields[name].kind](text);
      input.toggleAttribute("aria-invalid", value === null);
      if (value === null) {
        setText(wrong, `${fields[name].label}: “${text.slice(0, 30)}” is not ${fields[name].hint}.`);
        wrong.hidden = false;
        input.focus();
        return;
      }
      if (value !== undefined) reading[name] = value;
    }
    submit(reading);
  });
  return form;
};
