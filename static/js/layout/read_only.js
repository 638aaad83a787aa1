/** A page that may only look: its editing controls are hidden or inert, and it says so. The workbench refuses edits, too. */

import { store } from "../net/store.js";

const FIELDS = ".row-line input, .setting input, .setting select, .project-name, .scan-chip";
const ACTS = ["mousedown", "click", "beforeinput", "keydown"];
const LEAVES = new Set(["Tab", "Escape", "ArrowUp", "ArrowDown", "PageUp", "PageDown", "Home", "End"]);

/** Keep fields from being changed, but not from being read or left. */
const refuse = (event) => {
  if (!store.readOnly || !event.target.closest?.(FIELDS)) return;
  if (event.type === "keydown" && (LEAVES.has(event.key) || event.ctrlKey || event.metaKey) && !event.target.closest("select, [type=number]")) return;
  if (event.type === "keydown" && event.key === "Tab") return;
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
