/** Making elements. Text of others only ever becomes text: nothing here parses HTML. */

import { icon } from "./icons.js";

/**
 * @param {string} tag
 * @param {Record<string, any>} [properties] `class`, `role`, names with a dash and what is no property are attributes;
 *   `on` is {event: listener}; null and undefined are left out
 * @param {...(Node | string | number | null | undefined | false)} children
 * @returns {any}
 */
export const element = (tag, properties = {}, ...children) => {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (value === null || value === undefined) continue;
    if (name === "on") for (const [event, listener] of Object.entries(value)) made.addEventListener(event, listener);
    else if (name === "class" || name.includes("-") || !(name in made)) made.setAttribute(name, String(value));
    else made[name] = value;
  }
  made.append(...present(children));
  return made;
};

const present = (children) => children.flat().filter(
  (child) => child !== null && child !== undefined && child !== false,
);

/**
 * Replace what an element holds.
 * @param {Element} parent
 * @param {...(Node | string | null | undefined | false)} children
 */
export const put = (parent, ...children) => parent.replaceChildren(...present(children));

/**
 * A button.
 * @param {{label: string, act?: (event: Event) => void, icon?: string, title?: string, kind?: string, bare?: boolean,
 *          [attribute: string]: any}} of `bare`: only the icon is seen, the label is told
 * @returns {HTMLButtonElement}
 */
export const button = ({ label, act, icon: sign, title, kind = "", bare = false, ...rest }) =>
  element(
    "button",
    {
      type: "button",
      class: `button ${kind} ${bare ? "bare" : ""}`.trim(),
      title: title ?? (bare ? label : null),
      "aria-label": bare ? label : null,
      on: act ? { click: act } : {},
      ...rest,
    },
    sign ? icon(sign) : null,
    bare ? null : element("span", {}, label),
  );

/** Set text only where it differs, so that a screen reader hears it once. */
export const say = (target, text) => {
  if (target.textContent !== text) target.textContent = text;
};

/** Set or take away an attribute. */
export const attribute = (target, name, value) => {
  if (value === null || value === undefined || value === false) target.removeAttribute(name);
  else if (target.getAttribute(name) !== String(value)) target.setAttribute(name, String(value));
};

let count = 0;
/** @returns {string} an id that is nowhere else in the page */
export const newId = (what) => `${what}-${++count}`;

/**
 * Call `draw` once in the next frame, however often it is asked for.
 * @param {() => void} draw
 * @returns {() => void}
 */
export const inNextFrame = (draw) => {
  let asked = 0;
  return () => {
    asked ||= requestAnimationFrame(() => {
      asked = 0;
      draw();
    });
  };
};

/** @returns {boolean} whether the focus is where somebody types */
export const isTyping = (target) =>
  target instanceof Element &&
  target.closest(
    "input:not([type=checkbox], [type=radio], [type=range], [type=button]), textarea, select, [contenteditable]",
  ) !== null;
