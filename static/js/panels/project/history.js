/** The history of edits with author and time; a click goes to that state. */

import { request } from "../../net/requests.js";
import { store } from "../../net/store.js";
import { button } from "../../ui/controls.js";
import { makeDialog } from "../../ui/dialog.js";
import { element, setChildren } from "../../ui/dom.js";
import { icon } from "../../ui/icons.js";
import { opens, popoverOf } from "../../ui/popover.js";

/** @typedef {import("../../protocol.d.ts").HistoryEntry} Edit */

/**
 * Go to a state, which changes the project for everybody: ask first if others are connected.
 * @param {number} n
 * @param {string} label
 */
const goTo = (n, label) => {
  const others = store.colleagues().filter(({ read_only: looks }) => !looks);
  if (others.length === 0) return request("go_to", { n });
  const names = others.map(({ name }) => name).join(", ");
  const question = makeDialog(
    "Go to this state for everybody?",
    { kind: "question" },
    element(
      "p",
      {},
      `“${label}” becomes the state of the project, also for ${names}. Later edits, those of others included, are`,
      " undone; they can be redone until someone edits.",
    ),
    element(
      "div",
      { class: "dialog-buttons" },
      button({ label: "Cancel", act: () => question.close() }),
      button({ label: "Go to this state", kind: "primary", act: () => (question.close(), request("go_to", { n })) }),
    ),
  );
  question.dialog.addEventListener("close", () => question.dialog.remove());
  return question.open();
};

/** Attach the history to its button. @param {HTMLButtonElement} opener */
export const mountHistory = (opener) => {
  const list = element("ol", { class: "history-list", "aria-label": "Edits, newest first" });
  const panel = popoverOf(
    opener,
    "History",
    element("h2", {}, "History"),
    list,
    element(
      "p",
      { class: "dim" },
      "Going to a state changes the project for everybody. While others are connected, undo takes back your own edits",
      " only. Undone edits can be redone until a new edit is made.",
    ),
  );
  panel.classList.add("history");

  /** @param {Edit} edit @param {number} at the present state */
  const entry = ({ n, label, author, when }, at) => {
    const current = n === at;
    const item = button({
      label,
      kind: "history-entry plain",
      act: () => current || store.readOnly || goTo(n, label),
      "aria-current": current ? "step" : null,
      autofocus: current, // so that Escape returns the focus to the button
    });
    setChildren(
      item,
      element("span", { class: "sign" }, current ? icon("right") : null),
      element("span", { class: "clip", title: label }, label),
      element("span", { class: "dim clip" }, author),
      element("span", { class: "dim figures" }, when),
    );
    return element("li", { class: n > at ? "undone" : "" }, item);
  };
  const show = () => {
    /** @type {{at: number, entries: Edit[]}} */
    const history = store.get("history") ?? { at: 0, entries: [] };
    const focused = [...list.querySelectorAll("button")].findIndex((each) => each === document.activeElement);
    setChildren(list, ...history.entries.toReversed().map((each) => entry(each, history.at)));
    if (focused >= 0) list.querySelectorAll("button")[focused]?.focus();
  };
  store.watch(["history"], () => panel.matches(":popover-open") && show());
  panel.addEventListener("beforetoggle", (event) => opens(event) && show());
};
