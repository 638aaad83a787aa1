/** Small controls of the panes: buttons, selects, sliders, and what folds out of a button. */

import { element, newId } from "./dom.js";

/** @returns {HTMLButtonElement} */
export const button = (label, title, act, ...children) => {
  const made = element("button", { type: "button", class: "pane-button", title, "aria-label": label }, ...(children.length ? children : [label]));
  made.addEventListener("click", act);
  return made;
};

/** Show whether a button is pressed. */
export const press = (made, pressed) => made.setAttribute("aria-pressed", String(pressed));

/** Fill a select anew where its options have changed. @param {[string, string][]} options value and label */
export const fill = (select, options, value) => {
  const key = JSON.stringify(options);
  if (select.dataset.options !== key) {
    select.replaceChildren(...options.map(([each, label]) => element("option", { value: each }, label)));
    select.dataset.options = key;
  }
  if (select.value !== value) select.value = value;
};

/** @returns {HTMLSelectElement} */
export const choice = (label, changed) => {
  const made = element("select", { class: "pane-select", "aria-label": label, title: label });
  made.addEventListener("change", () => changed(made.value));
  return made;
};

/**
 * A slider with its name and its value.
 * @param {{label: string, least: number, most: number, step: number, text: (value: number) => string, changed: (value: number) => void}} of
 * @returns {{row: HTMLElement, show: (value: number) => void}}
 */
export const slider = ({ label, least, most, step, text, changed }) => {
  const input = element("input", { type: "range", min: least, max: most, step, "aria-label": label });
  const said = element("output", { class: "pane-value" });
  const show = (value) => {
    if (Number(input.value) !== value) input.value = value;
    input.setAttribute("aria-valuetext", text(value));
    said.textContent = text(value);
  };
  input.addEventListener("input", () => changed(Number(input.value)));
  return { row: element("label", { class: "pane-row" }, element("span", {}, label), input, said), show };
};

/** @returns {{row: HTMLElement, show: (value: boolean) => void}} a switch with its name */
export const tickBox = ({ label, changed }) => {
  const input = element("input", { type: "checkbox" });
  input.addEventListener("change", () => changed(input.checked));
  const show = (value) => {
    input.checked = value;
  };
  return { row: element("label", { class: "pane-row pane-tick" }, input, element("span", {}, label)), show };
};

/**
 * A button out of which controls fold, over everything else and below the button.
 * @returns {{opener: HTMLButtonElement, sheet: HTMLElement}}
 */
export const foldOut = (label, title, ...rows) => {
  const sheet = element("div", { class: "pane-sheet", popover: "auto", id: newId("pane-sheet"), role: "group", "aria-label": title }, ...rows);
  const opener = button(label, title, () => {});
  opener.popoverTargetElement = sheet;
  opener.setAttribute("aria-haspopup", "dialog");
  opener.classList.add("pane-opener");
  sheet.addEventListener("beforetoggle", (event) => {
    if (event.newState !== "open") return;
    const box = opener.getBoundingClientRect();
    sheet.style.setProperty("left", `min(${box.left}px, 100vw - 23rem)`);
    sheet.style.setProperty("top", `${box.bottom + 4}px`);
  });
  return { opener, sheet };
};
