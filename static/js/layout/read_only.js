/** A page that may only look: its editing controls are hidden or inert, and it says so. The workbench refuses edits, too. */

import { store } from "../net/store.js";

const FIELDS = ".row-line input, .setting input, .setting select, .project-name, .scan-chip";
const ACTS = ["mousedown", "click", "beforeinput", "keydown"];
const LEAVES = new Set(["Tab", "Escape", "ArrowUp", "ArrowDown", "PageUp", "PageDown", "Home", "End"]);

/** Keep fields from being changed, but not from being read or left. @param {Event} event */
const refuse = (event) => {
  const { target } = event;
  if (!store.readOnly || !(target instanceof Element) || !target.closest(FIELDS)) return;
  if (event instanceof KeyboardEvent) {
    if (event.key === "Tab") return;
    const leaves = LEAVES.has(event.key) || event.ctrlKey || event.metaKey;
    if (event.type === "keydown" && leaves && !target.closest("select, [type=number]")) return;
  }
  event.preventDefault();
  event.stopPropagation();
};

/** Hide what edits while the page may only look. */
export const followAccess = () => {
  const show = () => document.documentElement.classList.toggle("read-only", store.readOnly);
  store.watch(["people"], show);
  for (const act of ACTS) document.addEventListener(act, refuse, true);
  show();
};
