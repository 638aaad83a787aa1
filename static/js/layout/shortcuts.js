/** Keys of the whole page; those of the pictures are theirs (panes/). */

import { isTyping } from "../ui/dom.js";
import { wish } from "../net/requests.js";
import { toggleFilled } from "./maximise.js";
import { openKeys } from "../panels/keys_dialog.js";
import { notice } from "../ui/notices.js";
import { store } from "../net/store.js";
import { view } from "../state/view.js";

/** Whose own pop-ups and dialogs keep their keys. */
const inDialog = () => document.querySelector("dialog[open]") !== null;

const saved = () => {
  const project = store.get("project");
  if (project?.unsaved) notice(
    `The last steps could not be saved: ${project.unsaved_why || "see what the workbench printed"}`,
    "bad",
  );
  else notice(
    `Everything is saved already${project?.saved_at ? `, the last step at ${project.saved_at}` : ""}: ` +
      `there is nothing to do.`,
  );
};

/** The pane that the focus or the pointer is in. */
const paneMeant = () => {
  const pane = document.activeElement?.closest?.(".pane") ?? document.querySelector(".pane:hover");
  return pane?.id.replace("-pane", "") ?? null;
};

const commands = (event) => {
  const key = event.key.toLowerCase();
  if (key === "s") return saved;
  const figures = event.target.type === "number" || event.target.inputMode === "decimal";
  if (isTyping(event.target) && !figures) return null; // the field's own undo
  if (key === "z") return event.shiftKey ? () => wish("redo") : () => wish("undo");
  return key === "y" ? () => wish("redo") : null;
};

const plain = (event) => {
  if (event.key === "?") return openKeys;
  if (event.key === "h" || event.key === "H") return () => document.querySelector(".history-button").click();
  if (event.key === "f" || event.key === "F") {
    const pane = view.get().filled ?? paneMeant();
    return pane && (() => toggleFilled(pane));
  }
  const open = document.querySelector("[popover]:popover-open");
  return event.key === "Escape" && view.get().filled && !open ? () => view.set({ filled: null }) : null;
};

/** Listen from now on. */
export const listenToPageKeys = () => {
  addEventListener("keydown", (event) => {
    if (event.defaultPrevented || event.altKey) return;
    const command = event.ctrlKey || event.metaKey;
    const closesItself = event.key === "?" && document.querySelector(".keys-dialog[open]");
    if (inDialog() && !closesItself && !(command && event.key.toLowerCase() === "s")) return;
    if (!command && isTyping(event.target)) return;
    const act = command ? commands(event) : plain(event);
    if (!act) return;
    event.preventDefault();
    if (!event.repeat || command) act();
  });
};
