/** The list of connected clients, and the name under which one's own edits appear in the history. */

import { rememberName } from "../../net/identity.js";
import { request } from "../../net/requests.js";
import { store } from "../../net/store.js";
import { button } from "../../ui/controls.js";
import { element, newId, setChildren } from "../../ui/dom.js";
import { notice } from "../../ui/notices.js";
import { counted } from "../../ui/numbers.js";
import { popoverOf } from "../../ui/popover.js";

const copyLink = async () => {
  const answer = await request("read_only_link");
  if (!answer) return;
  const address = new URL("../../", location.href); // the login, outside this browser's session
  address.searchParams.set("token", answer.token);
  try {
    await navigator.clipboard.writeText(address.href);
    notice("The read-only link was copied: whoever opens it can look at everything, but change nothing.");
  } catch {
    notice(`The browser does not allow copying here. The read-only link is ${address.href}`); // not over plain http
  }
};

/**
 * A switch: see the photograph and the part of the pictures that another person sees.
 * @param {string} id
 * @param {string} name
 */
const followButton = (id, name) => {
  const follows = store.me()?.follows === id;
  return button({
    label: `Follow ${name}`,
    kind: "small toggle follow",
    title: `See the photograph and the part of the pictures that ${name} sees, until you move a picture yourself`,
    "aria-pressed": String(follows),
    act: () => request("follow", { client: follows ? null : id }),
  });
};

/** @returns {string} for the button in the header: whose view is followed, or how many people are connected */
export const clientsText = () => {
  const leader = store.colleagues().find(({ id }) => id === store.me()?.follows);
  return leader ? `Following ${leader.name}` : counted(store.get("people")?.count ?? 1, "client");
};

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
  const share = button({
    label: "Copy read-only link",
    icon: "link",
    kind: "small edits",
    title: "Copy a link with which others can look at everything, but change nothing",
    act: copyLink,
  });
  const panel = popoverOf(opener, "Connected clients", element("h2", {}, "Connected clients"), list, form, share);
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    const name = input.value.trim();
    const answer = name && (await request("call_me", { name }));
    if (!answer) return;
    rememberName(answer.you);
    panel.hidePopover();
  });
  const show = () => {
    const you = store.get("people")?.you;
    setChildren(
      list,
      ...store.clients().map(
        ({ id, name, colour, read_only: looks }) => element(
          "li",
          {},
          element("span", { class: `person person-${colour}`, "aria-hidden": "true" }),
          element("span", { class: "clip" }, name),
          element("span", { class: "dim" }, `${id === you ? " · you" : ""}${looks ? " · read only" : ""}`),
          id === you ? null : followButton(id, name),
        ),
      ),
    );
    if (document.activeElement !== input) input.value = store.me()?.name ?? "";
  };
  store.watch(["people"], show);
  panel.addEventListener("toggle", show);
};
