/** Controls: buttons, selects, sliders, tick boxes, and sheets that open below a button. */

import { element, newId } from "./dom.js";
import { icon } from "./icons.js";
import { opens } from "./popover.js";

/**
 * A button.
 * @param {{label: string, text?: string, act?: (event: Event) => void, icon?: string, title?: string, kind?: string,
 *          bare?: boolean, [attribute: string]: any}} options `text` is shown in place of `label`, which is then only
 *   announced; a `bare` button shows its icon alone; `kind` adds CSS classes; the rest become attributes
 * @returns {HTMLButtonElement}
 */
export const button = ({ label, text = label, act, icon: sign, title, kind = "", bare = false, ...rest }) =>
  element(
    "button",
    {
      type: "button",
      class: `button ${kind} ${bare ? "bare" : ""}`.trim(),
      title: title ?? (bare ? label : null),
      "aria-label": bare || text !== label ? label : null,
      on: act ? { click: act } : {},
      ...rest,
    },
    sign ? icon(sign) : null,
    bare ? null : element("span", {}, text),
  );

/** Show whether a toggle button is pressed. @param {Element} toggle @param {boolean} pressed */
export const press = (toggle, pressed) => toggle.setAttribute("aria-pressed", String(pressed));

/**
 * Set the value of a select, and its options if they have changed.
 * @param {HTMLSelectElement} select
 * @param {[string, string][]} options value and label
 * @param {string} value
 */
export const fill = (select, options, value) => {
  const key = JSON.stringify(options);
  if (select.dataset.options !== key) {
    select.replaceChildren(...options.map(([each, label]) => element("option", { value: each }, label)));
    select.dataset.options = key;
  }
  if (select.value !== value) select.value = value;
};

/**
 * @param {string} label
 * @param {(value: string) => void} changed
 * @returns {HTMLSelectElement} a select without options yet; see `fill`
 */
export const choice = (label, changed) => {
  const select = element("select", { class: "pane-select", "aria-label": label, title: label });
  select.addEventListener("change", () => changed(select.value));
  return select;
};

/**
 * A slider with its label and its value.
 * @param {{label: string, least: number, most: number, step: number, text: (value: number) => string, changed: (value:
 *   number) => void, released?: () => void}} options `changed` is called while it is dragged, `released` at the end
 * @returns {{row: HTMLElement, show: (value: number) => void}}
 */
export const slider = ({ label, least, most, step, text, changed, released = () => {} }) => {
  const input = element("input", { type: "range", min: least, max: most, step, "aria-label": label });
  const output = element("output", { class: "pane-value" });
  /** @param {number} value */
  const show = (value) => {
    if (Number(input.value) !== value) input.value = String(value);
    input.setAttribute("aria-valuetext", text(value));
    output.textContent = text(value);
  };
  input.addEventListener("input", () => changed(Number(input.value)));
  // a slider that is dragged back to where it was does not report a change
  for (const end of ["change", "pointerup", "pointercancel", "blur"]) input.addEventListener(end, released);
  return { row: element("label", { class: "pane-row" }, element("span", {}, label), input, output), show };
};

/**
 * A tick box with its label.
 * @param {{label: string, changed: (on: boolean) => void}} options
 * @returns {{row: HTMLElement, show: (value: boolean) => void}}
 */
export const tickBox = ({ label, changed }) => {
  const input = element("input", { type: "checkbox" });
  input.addEventListener("change", () => changed(input.checked));
  /** @param {boolean} value */
  const show = (value) => {
    input.checked = value;
  };
  return { row: element("label", { class: "pane-row pane-tick" }, input, element("span", {}, label)), show };
};

/**
 * A button that opens a sheet of controls below itself.
 * @param {string} label
 * @param {string} title
 * @param {...HTMLElement} rows
 * @returns {{opener: HTMLButtonElement, sheet: HTMLElement}}
 */
export const foldOut = (label, title, ...rows) => {
  const sheet = element("div", { class: "pane-sheet", popover: "auto", id: newId("pane-sheet"), role: "group", "aria-label": title }, ...rows);
  const opener = button({ label, title, kind: "pane-button pane-opener" });
  opener.popoverTargetElement = sheet;
  opener.setAttribute("aria-haspopup", "dialog");
  sheet.addEventListener("beforetoggle", (event) => {
    if (!opens(event)) return;
    const box = opener.getBoundingClientRect();
    sheet.style.setProperty("left", `min(${box.left}px, 100vw - 23rem)`);
    sheet.style.setProperty("top", `${box.bottom + 4}px`);
  });
  return { opener, sheet };
};
