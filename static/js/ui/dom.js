/** Creation and update of elements. Nothing here parses HTML: foreign text can only become text. */

/**
 * @typedef {{[Name in keyof HTMLElementEventMap]?: (event: HTMLElementEventMap[Name]) => any}} Listeners
 * @typedef {{on?: Listeners, [name: string]: any}} Properties
 * @typedef {Node | string | number | null | undefined | false} Child
 */

/**
 * Create an element.
 * @template {keyof HTMLElementTagNameMap} Tag
 * @param {Tag} tag
 * @param {Properties} [properties] `class`, names with a dash and names that are no properties become attributes; `on` is
 *   {event: listener}; null and undefined are skipped
 * @param {...(Child | Child[])} children
 * @returns {HTMLElementTagNameMap[Tag]}
 */
export const element = (tag, { on = {}, ...properties } = {}, ...children) => {
  const node = document.createElement(tag);
  for (const [event, listener] of Object.entries(on)) node.addEventListener(event, /** @type {EventListener} */ (listener));
  for (const [name, value] of Object.entries(properties)) {
    if (value === null || value === undefined) continue;
    if (name === "class" || name.includes("-") || !(name in node)) node.setAttribute(name, String(value));
    else Object.assign(node, { [name]: value });
  }
  node.append(...present(children));
  return node;
};

/** @param {(Child | Child[])[]} children @returns {(Node | string)[]} */
const present = (children) => children.flat().flatMap((child) => {
  if (child === null || child === undefined || child === false) return [];
  return typeof child === "number" ? String(child) : child;
});

const SVG = "http://www.w3.org/2000/svg";

/**
 * Create an element of a drawing.
 * @template {keyof SVGElementTagNameMap} Name
 * @param {Name} name of SVG
 * @param {Record<string, any>} [attributes]
 * @param {...(Node | string)} children
 * @returns {SVGElementTagNameMap[Name]}
 */
export const shape = (name, attributes = {}, ...children) => {
  const node = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, String(value));
  node.append(...children);
  return node;
};

/**
 * Replace the children of an element.
 * @param {Element} parent
 * @param {...(Child | Child[])} children
 */
export const setChildren = (parent, ...children) => parent.replaceChildren(...present(children));

/** Set the text only if it differs, so that a screen reader announces it once. @param {Node} target @param {string} text */
export const setText = (target, text) => {
  if (target.textContent !== text) target.textContent = text;
};

/**
 * Set an attribute, or remove it if the value is null, undefined or false.
 * @param {Element} target
 * @param {string} name
 * @param {string | number | boolean | null | undefined} value
 */
export const setAttribute = (target, name, value) => {
  if (value === null || value === undefined || value === false) target.removeAttribute(name);
  else if (target.getAttribute(name) !== String(value)) target.setAttribute(name, String(value));
};

/**
 * Find an element that is there by construction: it is in index.html, or the page has made it.
 * @param {ParentNode} parent
 * @param {string} selector
 * @returns {HTMLElement}
 * @throws {Error} if there is none
 */
export const partOf = (parent, selector) => {
  /** @type {HTMLElement | null} */
  const found = parent.querySelector(selector);
  if (!found) throw new Error(`The page has no element ${selector}, so its parts are of different versions: reload the page.`);
  return found;
};

/** @param {string} id @returns {HTMLElement} as `partOf`, of the whole page */
export const byId = (id) => partOf(document, `#${id}`);

let count = 0;
/** @param {string} prefix @returns {string} an id that is unique in the page */
export const newId = (prefix) => `${prefix}-${++count}`;

/** @param {EventTarget | null} target @returns {boolean} whether a key press at the target is typed text */
export const isTyping = (target) =>
  target instanceof Element &&
  target.closest(
    "input:not([type=checkbox], [type=radio], [type=range], [type=button]), textarea, select, [contenteditable]",
  ) !== null;
