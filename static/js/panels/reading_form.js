/** The form for what a file does not say itself: where the scanner stood, the unit of temperatures, and so on. */

import { element, newId, setText } from "../ui/dom.js";

const numberOf = (text) => (text.trim() === "" ? Number.NaN : Number(text));

/** Options of a scan's reader: how each is asked for, and its value from what was typed; null if that is wrong. */
const OPTIONS = {
  scan_index: {
    label: "Scan of the file",
    hint: "its number, counted from 0",
    example: "0",
    read: (text) => (/^\d+$/u.test(text) ? Number(text) : null),
  },
  origin: {
    label: "Scanner stood at",
    hint: "x, y, z in the file's coordinates, m",
    example: "12.5, -3, 1.8",
    read: (text) => {
      const values = text.split(/[\s,;]+/u).map(numberOf);
      return values.length === 3 && values.every(Number.isFinite) ? values : null;
    },
  },
  columns: {
    label: "Columns",
    hint: "names in order; - skips one",
    example: "x, y, z, intensity",
    read: (text) => text.split(/[\s,;]+/u),
  },
  topic: { label: "Topic", hint: "of the clouds in the recording", example: "/points", read: (text) => text },
  seconds: {
    label: "Accumulate over",
    hint: "seconds",
    example: "2",
    read: (text) => (numberOf(text) > 0 ? numberOf(text) : null),
  },
  temperature_unit: {
    label: "Unit of its temperatures",
    hint: "K or C; none for an ordinary picture",
    example: "C",
    read: (text) => ({ k: "K", c: "C", none: "none" })[text.toLowerCase().replace(/°|deg\s*/u, "")] ?? null,
  },
  camera_name: {
    label: "Camera",
    hint: "its name in the file",
    example: "cam0",
    read: (text) => text,
  },
};

/**
 * @param {string[]} takes names of the options that the file's reader takes
 * @param {(reading: Record<string, unknown>) => void} submit receives the options that were filled in
 * @param {string[]} [scans] descriptions of the file's scans, if it contains several
 * @returns {HTMLFormElement}
 */
export const readingForm = (takes, submit, scans = []) => {
  const inputs = new Map();
  const rows = takes
    .filter((name) => name in OPTIONS)
    .map((name) => {
      const { label, hint, example } = OPTIONS[name];
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
    takes.includes("intensity")
      ? element("label", { class: "row" }, luma, "Use the brightness of the colours as the intensity")
      : null,
    wrong,
    element("div", { class: "form-foot" }, element("button", { class: "button primary edits", type: "submit" }, act)),
  );
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    const reading = luma.checked ? { intensity: "luma" } : {};
    wrong.hidden = true;
    for (const [name, input] of inputs) {
      const text = input.value.trim();
      const value = text === "" ? undefined : OPTIONS[name].read(text);
      input.toggleAttribute("aria-invalid", value === null);
      if (value === null) {
        setText(wrong, `${OPTIONS[name].label}: “${text.slice(0, 30)}” is not ${OPTIONS[name].hint}.`);
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
