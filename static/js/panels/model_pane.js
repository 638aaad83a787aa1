/** The 3-D model: viser's page in a frame, with the display options. */

import { connectionState, onConnection } from "../net/connection.js";
import { request } from "../net/requests.js";
import { store } from "../net/store.js";
import { button } from "../ui/controls.js";
import { element, setChildren } from "../ui/dom.js";
import { whenFirstPicturesArrived } from "../ui/first_pictures.js";
import { mountSoftwareHint } from "./software_drawing.js";

const SWITCHES = [
  [
    "z_buffer",
    "Hide occluded",
    "On: the photograph colours only what the camera saw. Off: what lies behind, too (thesis Figure 2.23)",
  ],
  ["light", "Coarse mesh", "Use a coarser mesh, for slow computers"],
  ["cameras", "Cameras", "Show scanner and camera"],
  ["matches", "Matches", "Show the matches in 3-D"],
];

const controls = () => {
  const texture = element(
    "select",
    {
      class: "select",
      "aria-label": "Texture of the model",
      title: "Texture of the model",
      on: { change: () => request("set_model", { texture: texture.value }) },
    },
  );
  const switches = SWITCHES.map(([name, label, title]) => {
    const toggle = button({
      label,
      title,
      kind: "small toggle",
      act: () => request("set_model", { [name]: toggle.getAttribute("aria-pressed") !== "true" }),
    });
    toggle.firstElementChild.classList.add("clip");
    return [name, toggle];
  });
  let drawn = "";
  const show = () => {
    const model = store.get("model");
    const text = JSON.stringify(model?.choices ?? []);
    if (text !== drawn) {
      drawn = text;
      setChildren(
        texture,
        ...(model?.choices ?? []).map(
          ({ value, label, usable, said }) => element(
            "option",
            { value, disabled: !usable, title: said },
            usable ? label : `${label} · not available yet`,
          ),
        ),
      );
    }
    if (model) texture.value = model.texture;
    texture.disabled = !model;
    for (const [name, toggle] of switches) {
      toggle.disabled = !model;
      toggle.setAttribute("aria-pressed", String(Boolean(model?.[name])));
    }
  };
  store.watch(["model"], show);
  show();
  return [texture, ...switches.map(([, toggle]) => toggle)];
};

const TYPING = "input, textarea, select, [contenteditable], [role=textbox]";

/** Show that the focus is inside the frame, which CSS cannot detect. */
const showFocus = (frame) => {
  const inner = frame.contentWindow;
  inner.addEventListener("focus", () => frame.classList.add("focused"));
  inner.addEventListener("blur", () => frame.classList.remove("focused"));
};

/** Forward keys from the frame to the page, except while text is typed. */
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

/** Mount the frame and its controls. @param {HTMLElement} pane */
export const mountModelPane = (pane) => {
  pane.querySelector(".pane-controls").append(...controls());
  const body = pane.querySelector(".pane-body");
  const frame = element("iframe", { class: "model-frame", title: "3-D model", allow: "fullscreen" });
  whenFirstPicturesArrived().then(() => frame.setAttribute("src", "viser/"));
  frame.addEventListener("load", () => {
    try {
      forwardKeys(frame);
      showFocus(frame);
    } catch {
      // the frame shows the browser's error page, which is not accessible
    }
  });
  const note = element("p", { class: "pane-empty", hidden: true });
  body.append(frame, note);
  mountSoftwareHint(body);
  const show = () => {
    const scan = store.get("scan");
    setChildren(
      note,
      connectionState() === "connected" && !scan
        ? "The scan is shown here as a surface, with the camera."
        : "",
    );
    note.hidden = note.textContent === "";
  };
  store.watch(["scan"], show);
  onConnection(show);
  show();
};
