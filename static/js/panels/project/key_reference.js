/** The keyboard reference: all keys of the workbench, and the dialog that lists them. */

import { makeDialog } from "../../ui/dialog.js";
import { element } from "../../ui/dom.js";

/** @type {{keys: string, what: string, group: string}[]} */
const KEYS = [
  { group: "Draw", keys: "L", what: "Draw lines" },
  { group: "Draw", keys: "P", what: "Set points" },
  { group: "Draw", keys: "D", what: "Measure: Enter finishes, Esc takes the last point back" },
  { group: "Draw", keys: "V or S", what: "Select and move" },
  { group: "Draw", keys: "Enter", what: "Accept the dashed partner; without a mouse: set an end at the crosshair" },
  { group: "Draw", keys: "Esc", what: "Cancel the drawing" },
  { group: "Draw", keys: "Shift held", what: "Suspend snapping" },
  { group: "Draw", keys: "N", what: "Snapping on or off: lines to the edge under them, points to a corner" },
  { group: "Draw", keys: "O", what: "Loupe on or off" },
  { group: "Draw", keys: "← ↑ → ↓", what: "Move the crosshair by 1 px (Shift 10, Ctrl 0.1)" },
  { group: "Draw", keys: "Ctrl held", what: "Select and move, with any tool" },
  { group: "Matches", keys: "Tab, Shift Tab", what: "In a picture: next, previous match" },
  { group: "Matches", keys: "[ and ]", what: "Previous, next end of the selected match" },
  { group: "Matches", keys: "← ↑ → ↓", what: "Move the selected end by 0.1 px (Shift 1)" },
  { group: "Matches", keys: "Space", what: "Disable or enable the selected matches" },
  { group: "Matches", keys: "Delete", what: "Remove the selected matches" },
  { group: "Matches", keys: "Ctrl A", what: "Select all" },
  { group: "Matches", keys: "Shift, Ctrl click", what: "In the table: select a range, or add one" },
  { group: "Matches", keys: "Enter", what: "In the table: show the match in the pictures" },
  { group: "View", keys: "Wheel, + and −", what: "Zoom at the cursor" },
  { group: "View", keys: "Space or right drag", what: "Pan" },
  { group: "View", keys: "0, double click", what: "Fit the picture" },
  { group: "View", keys: "1", what: "One image pixel per screen pixel" },
  { group: "View", keys: "X", what: "Hide or show the matches in the pictures" },
  { group: "View", keys: "C", what: "Show or hide detected corners" },
  { group: "View", keys: "K", what: "Link both pictures" },
  { group: "View", keys: "Page Up, Page Down", what: "Previous, next view of the scan" },
  { group: "View", keys: "M", what: "Hide or show scanner, camera and matches in the 3-D view" },
  { group: "View", keys: "F", what: "Maximise this pane; again, or Esc, restores" },
  { group: "General", keys: "Ctrl Z", what: "Undo" },
  { group: "General", keys: "Ctrl Shift Z, Ctrl Y", what: "Redo" },
  { group: "General", keys: "Ctrl S", what: "Show when the project was last saved (edits are saved automatically)" },
  { group: "General", keys: "H", what: "History" },
  { group: "General", keys: "F8", what: "Stop the pan/tilt unit and switch the laser off" },
  { group: "General", keys: "?", what: "Keyboard reference" },
  { group: "General", keys: "← → ↑ ↓", what: "On a divider: move it (Shift: faster)" },
  { group: "General", keys: "↑ ↓", what: "On the depth-error plot: move the threshold" },
];

let reference = null;

const build = () => {
  const groups = [...new Set(KEYS.map(({ group }) => group))];
  /** @param {string} group */
  const table = (group) =>
    element(
      "section",
      {},
      element("h3", {}, group),
      element(
        "dl",
        { class: "keys" },
        ...KEYS.filter((key) => key.group === group).flatMap(
          ({ keys, what }) => [element("dt", {}, element("kbd", {}, keys)), element("dd", {}, what)],
        ),
      ),
    );
  return makeDialog("Keyboard reference", { kind: "keys-dialog" }, element("div", { class: "keys-groups" }, ...groups.map(table)));
};

/** Open or close the reference. */
export const openKeys = () => {
  reference ??= build();
  if (reference.dialog.open) reference.close();
  else reference.open();
};
