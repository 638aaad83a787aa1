/** The list of connected clients, and the name under which one's own edits appear in the history. */

import { rememberName } from "../net/identity.js";
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
    const answer = name && (await request("call_me", { name }));
    if (!answer) return;
    rememberName(answer.you);
    panel.hidePopover();
  });
  const show = () => {
    const { clients, you } = store.get("people") ?? { clients: [] };
    setChildren(
      list,
      ...clients.map(
        ({ id, name }) => element("li", {}, name, id === you ? element("span", { class: "dim" }, " · you") : null),
      ),
    );
    if (document.activeElement !== input) input.value = store.me()?.name ?? "";
  };
  store.watch(["people"], show);
  panel.addEventListener("toggle", show);
};
