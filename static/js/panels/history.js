/** The history: every step with its author and time; a click goes there. */

import { button, element, put } from "../ui/dom.js";
import { wish } from "../net/requests.js";
import { icon } from "../ui/icons.js";
import { popoverOf } from "../ui/popover.js";
import { store } from "../net/store.js";

/** @param {HTMLButtonElement} opener */
export const mountHistory = (opener) => {
  const list = element("ol", { class: "history-list", "aria-label": "Steps, the newest first" });
  const panel = popoverOf(
    opener,
    "History",
    element("h2", {}, "History"),
    list,
    element("p", { class: "dim" }, "Shared by all who are here. Going back loses nothing until something new is done."),
  );
  panel.classList.add("history");

  const entry = ({ n, label, author, when }, at) => {
    const present = n === at;
    const made = button({
      label,
      kind: "history-entry plain",
      act: () => present || wish("go_to", { n }),
      "aria-current": present ? "step" : null,
      autofocus: present, // when the panel opens; Escape then gives the focus back
    });
    put(
      made,
      element("span", { class: "sign" }, present ? icon("right") : null),
      element("span", { class: "clip", title: label }, label),
      element("span", { class: "dim clip" }, author),
      element("span", { class: "dim figures" }, when),
    );
    return element("li", { class: n > at ? "undone" : "" }, made);
  };
  const show = () => {
    const history = store.get("history") ?? { at: 0, entries: [] };
    const focused = [...list.querySelectorAll("button")].indexOf(document.activeElement);
    put(list, ...history.entries.toReversed().map((each) => entry(each, history.at)));
    if (focused >= 0) list.querySelectorAll("button")[focused]?.focus();
  };
  store.watch(["history"], () => panel.matches(":popover-open") && show());
  panel.addEventListener("beforetoggle", (event) => event.newState === "open" && show());
};
