/** The keyboard reference. */

import { element } from "../ui/dom.js";
import { makeDialog } from "../ui/dialog.js";
import { KEYS } from "./keys.js";

let made = null;

const build = () => {
  const groups = [...new Set(KEYS.map(({ group }) => group))];
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
  return makeDialog("Keys", { kind: "keys-dialog" }, element("div", { class: "keys-groups" }, ...groups.map(table)));
};

/** Show it, or put it away. */
export const openKeys = () => {
  made ??= build();
  if (made.dialog.open) made.close();
  else made.open();
};
