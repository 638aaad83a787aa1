/** The 3-D model: viser's own page in a frame, and what is shared of how it looks. */

import { element, put } from "../ui/dom.js";
import { connectionState, onConnection } from "../net/connection.js";
import { wish } from "../net/requests.js";
import { mountSoftwareHint } from "./software_drawing.js";
import { store } from "../net/store.js";

const SWITCHES = [
  [
    "z_buffer",
    "z-buffer",
    "On: the photograph colours what the camera saw. Off: everything behind it, too (thesis Figure 2.23)",
  ],
  ["light", "light", "A coarser mesh, for slow machines"],
  ["cameras", "cameras", "Show where scanner and camera stand"],
  ["matches", "matches", "Show the matches in space"],
];

const controls = () => {
  const texture = element(
    "select",
    {
      class: "select",
      "aria-label": "Texture of the model",
      title: "What the model is painted with",
      on: { change: () => wish("set_model", { texture: texture.value }) },
    },
  );
  const switches = SWITCHES.map(([name, label, said]) => {
    const made = element("button", { type: "button", class: "button small toggle", title: said }, label);
    made.addEventListener("click", () => wish("set_model", { [name]: made.getAttribute("aria-pressed") !== "true" }));
    return [name, made];
  });
  let drawn = "";
  const show = () => {
    const model = store.get("model");
    const text = JSON.stringify(model?.choices ?? []);
    if (text !== drawn) {
      drawn = text;
      put(
        texture,
        ...(model?.choices ?? []).map(
          ({ value, label, usable, said }) => element(
            "option",
            { value, disabled: !usable, title: said },
            usable ? label : `${label} · not yet`,
          ),
        ),
      );
    }
    if (model) texture.value = model.texture;
    texture.disabled = !model;
    for (const [name, made] of switches) {
      made.disabled = !model;
      made.setAttribute("aria-pressed", String(Boolean(model?.[name])));
    }
  };
  store.watch(["model"], show);
  show();
  return [texture, ...switches.map(([, made]) => made)];
};

const TYPING = "input, textarea, select, [contenteditable], [role=textbox]";

/** A frame never says that the focus is inside it: show where the keys go. */
const showFocus = (frame) => {
  const inner = frame.contentWindow;
  inner.addEventListener("focus", () => frame.classList.add("focused"));
  inner.addEventListener("blur", () => frame.classList.remove("focused"));
};

/** Keys pressed in the frame would stay there: send them to the page, except where somebody types. */
const forwardKeys = (frame) => {
  const inner = frame.contentWindow;
  for (const kind of ["keydown", "keyup"]) {
    inner.addEventListener(kind, (event) => {
      if (event.defaultPrevented || event.target.closest?.(TYPING)) return;
      const { key, code, ctrlKey, shiftKey, altKey, metaKey, repeat } = event;
      const sent = new KeyboardEvent(
        kind,
        { key, code, ctrlKey, shiftKey, altKey, metaKey, repeat, bubbles: true, cancelable: true },
      );
      if (!frame.dispatchEvent(sent)) event.preventDefault();
    });
  }
};

/** @param {HTMLElement} pane */
export const mountModelPane = (pane) => {
  pane.querySelector(".pane-controls").append(...controls());
  const body = pane.querySelector(".pane-body");
  const frame = element("iframe", { class: "model-frame", src: "viser/", title: "3-D model", allow: "fullscreen" });
  frame.addEventListener("load", () => {
    try {
      forwardKeys(frame);
      showFocus(frame);
    } catch {
      // the frame shows an error page of the browser's own: there is nothing to listen to
    }
  });
  const note = element("p", { class: "pane-empty", hidden: true });
  body.append(frame, note);
  mountSoftwareHint(body);
  const show = () => {
    const scan = store.get("scan");
    put(
      note,
      connectionState() === "connected" && !scan
        ? "The scan will stand here as a surface, with the camera beside it."
        : "",
    );
    note.hidden = note.textContent === "";
  };
  store.watch(["scan"], show);
  onConnection(show);
  show();
};
