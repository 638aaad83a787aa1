/** Keyboard shortcuts of the whole page; panes/keyboard.js has those of the pictures. */

import { request } from "../net/requests.js";
import { store } from "../net/store.js";
import { stopAcquisition } from "../panels/acquire/run.js";
import { canBeStopped } from "../state/acquisition.js";
import { openKeys } from "../panels/project/key_reference.js";
import { toggleMarks } from "../panels/model/model_pane.js";
import { view } from "../state/view.js";
import { isTyping, partOf } from "../ui/dom.js";
import { notice } from "../ui/notices.js";
import { toggleMaximised } from "./maximise.js";

/** Stops the devices of an acquisition. */
const STOP = "F8";

/** Dialogs keep their keys. */
const inDialog = () => document.querySelector("dialog[open]") !== null;

const reportSaved = () => {
  const project = store.get("project");
  if (project?.unsaved) notice(
    `The last edits could not be saved: ${project.unsaved_why || "see the output of the workbench"}`,
    "bad",
  );
  else notice(
    `All edits are saved automatically${project?.saved_at ? `, the last one at ${project.saved_at}` : ""}.`,
  );
};

/** @returns {import("./maximise.js").PaneName | null} the pane with the focus, or under the pointer */
const currentPane = () => {
  const pane = document.activeElement?.closest?.(".pane") ?? document.querySelector(".pane:hover");
  return /** @type {import("./maximise.js").PaneName | undefined} */ (pane?.id.replace("-pane", "")) ?? null;
};

/** @param {KeyboardEvent} event @returns {(() => void) | null} what a key with Ctrl or Command does */
const commands = (event) => {
  const key = event.key.toLowerCase();
  if (key === "s") return reportSaved;
  const { target } = event;
  const figures = target instanceof HTMLInputElement && (target.type === "number" || target.inputMode === "decimal");
  if (isTyping(target) && !figures) return null; // the field has its own undo
  if (store.readOnly) return null;
  if (key === "z") return event.shiftKey ? () => request("redo") : () => request("undo");
  return key === "y" ? () => request("redo") : null;
};

/** @param {KeyboardEvent} event @returns {(() => void) | null} what a key alone does */
const plain = (event) => {
  if (event.key === "?") return openKeys;
  if (event.key === "h" || event.key === "H") {
    return () => partOf(document, ".history-button").click();
  }
  if (event.key === "m" || event.key === "M") return toggleMarks;
  if (event.key === "f" || event.key === "F") {
    const pane = view.get().filled ?? currentPane();
    return pane && (() => toggleMaximised(pane));
  }
  const open = document.querySelector("[popover]:popover-open");
  return event.key === "Escape" && view.get().filled && !open ? () => view.set({ filled: null }) : null;
};

/** Listen to the keyboard. */
export const listenToShortcuts = () => {
  addEventListener("keydown", (event) => {
    if (event.key === STOP && canBeStopped()) {
      event.preventDefault();
      stopAcquisition(); // whatever has the focus
      return;
    }
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
