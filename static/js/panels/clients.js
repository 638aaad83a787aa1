/** Who is here, and by which name one's own steps go into the history. */

import { element, newId, put } from "../ui/dom.js";
import { wish } from "../net/requests.js";
import { popoverOf } from "../ui/popover.js";
import { store } from "../net/store.js";

/** @param {HTMLButtonElement} opener */
export const mountPeople = (opener) => {
  const list = element("ul", { class: "people-list" });
  const id = newId("field");
  const input = element("input", { id, maxLength: 40, autocomplete: "name", spellcheck: false });
  const form = element(
    "form",
    { class: "people-form" },
    element("label", { for: id }, "Your name"),
    input,
    element("button", { type: "submit", class: "button" }, "Call me so"),
  );
  const panel = popoverOf(opener, "Who is here", element("h2", {}, "Here now"), list, form);
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    const name = input.value.trim();
    if (name && (await wish("call_me", { name }))) panel.hidePopover();
  });
  const show = () => {
    const people = store.get("people") ?? { names: [] };
    const you = people.you ?? store.get("you");
    put(
      list,
      ...(people.names ?? []).map(
        (name) => element("li", {}, name, name === you ? element("span", { class: "dim" }, " · you") : null),
      ),
    );
    if (document.activeElement !== input) input.value = you ?? "";
  };
  store.watch(["people", "you"], show);
  panel.addEventListener("toggle", show);
};
