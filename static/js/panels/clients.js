/** The list of connected clients, and the name under which one's own edits appear in the history. */

import { request } from "../net/requests.js";
import { store } from "../net/store.js";
import { element, newId, setChildren } from "../ui/dom.js";
import { popoverOf } from "../ui/popover.js";

/** Attach the list to its button. @param {HTMLButtonElement} opener */
export const mountClients = (opener) => {
  const list = element("ul", { class: "clients-list" });
  const id = newId("field");
  const input = element("input", { id, maxLength: 40, autocomplete: "name", spellcheck: false });
  const form = element(
    "form",
    { class: "clients-form" },
    element("label", { for: id }, "Your name"),
    input,
    element("button", { type: "submit", class: "button" }, "Set name"),
  );
  const panel = popoverOf(opener, "Connected clients", element("h2", {}, "Connected clients"), list, form);
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    const name = input.value.trim();
    if (name && (await request("call_me", { name }))) panel.hidePopover();
  });
  const show = () => {
    const clients = store.get("people") ?? { names: [] };
    const you = clients.you ?? store.get("you");
    setChildren(
      list,
      ...(clients.names ?? []).map(
        (name) => element("li", {}, name, name === you ? element("span", { class: "dim" }, " · you") : null),
      ),
    );
    if (document.activeElement !== input) input.value = you ?? "";
  };
  store.watch(["people", "you"], show);
  panel.addEventListener("toggle", show);
};
