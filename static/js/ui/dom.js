/** Creation and update of elements. Nothing here parses HTML: foreign text can only become text. */

/**
 * Create an element.
 * @param {string} tag
 * @param {Record<string, any>} [properties] `class`, names with a dash and names that are no properties become
 *   attributes; `on` is {event: listener}; null and undefined are skipped
 * @param {...(Node | string | number | null | undefined | false)} children
 * @returns {any}
 */
export const element = (tag, properties = {}, ...children) => {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (value === null || value === undefined) continue;
    if (name === "on") for (const [event, listener] of Object.entries(value)) node.addEventListener(event, listener);
    else if (name === "class" || name.includes("-") || !(name in node)) node.setAttribute(name, String(value));
    else node[name] = value;
  }
  node.append(...present(children));
  return node;
};

const present = (children) => children.flat().filter(
  (child) => child !== null && child !== undefined && child !== false,
);

const SVG = "http://www.w3.org/2000/svg";

/**
 * Create an element of a drawing.
 * @param {string} name of SVG
 * @param {Record<string, any>} [attributes]
 * @param {...(Node | string)} children
 * @returns {any}
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
 * @param {...(Node | string | null | undefined | false)} children
 */
export const setChildren = (parent, ...children) => parent.replaceChildren(...present(children));

/** Set the text only if it differs, so that a screen reader announces it once. */
export const setText = (target, text) => {
  if (target.textContent !== text) target.textContent = text;
};

/** Set an attribute, or remove it if the value is null, undefined or false. */
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
/** @returns {string} an id that is unique in the page */
export const newId = (prefix) => `${prefix}-${++count}`;

/** @returns {boolean} whether a key press at the target is typed text */
export const isTyping = (target) =>
  target instanceof Element &&
  target.closest(
    "input:not([type=checkbox], [type=radio], [type=range], [type=button]), textarea, select, [contenteditable]",
  ) !== null;
