/** Telling the focal length of a photograph: in pixels, in millimetres, or by a camera file. */

import { button, element, newId, put, say } from "./dom.js";
import { ask } from "./connection.js";
import { fixed } from "./numbers.js";
import { popoverOf } from "./popover.js";
import { sendFile } from "./uploads.js";
import { store } from "./store.js";

const field = (label, unit, example) => {
  const id = newId("field");
  const input = element("input", { id, type: "number", min: "0", step: "any", placeholder: example, class: "number" });
  return {
    input,
    row: element(
      "div",
      { class: "field" },
      element("label", { for: id }, label),
      input,
      element("span", { class: "dim" }, unit),
    ),
  };
};

/** @param {HTMLButtonElement} opener */
export const mountCameraForm = (opener) => {
  const px = field("Focal length", "px", "1000");
  const mm = field("Focal length", "mm", "35");
  const sensor = field("Sensor width", "mm", "36");
  const head = element("p", { class: "form-head" });
  const wrong = element("p", { class: "form-wrong", role: "alert", hidden: true });
  const file = element(
    "input",
    { type: "file", accept: ".json,.yaml,.yml,.xml", class: "told", tabIndex: -1, "aria-hidden": "true" },
  );
  const form = element(
    "form",
    { class: "camera-form" },
    head,
    element("fieldset", {}, element("legend", {}, "In pixels"), px.row),
    element("p", { class: "or" }, "or"),
    element("fieldset", {}, element("legend", {}, "In millimetres"), mm.row, sensor.row),
    wrong,
    element(
      "div",
      { class: "form-foot" },
      button({
        label: "Camera file…",
        icon: "file",
        title: "A camera file: JSON or OpenCV's YAML",
        act: () => file.click(),
      }),
      element("button", { class: "button primary", type: "submit" }, "Use it"),
    ),
    file,
  );
  const panel = popoverOf(opener, "Camera of the photograph", form);
  const fail = (text) => {
    say(wrong, text);
    wrong.hidden = text === "";
  };
  const done = () => {
    fail("");
    panel.hidePopover();
  };

  const wanted = () => {
    const numbers = Object.fromEntries(
      Object.entries({ focal_px: px, focal_mm: mm, sensor_mm: sensor }).map(
        ([name, { input }]) => [name, input.valueAsNumber],
      ),
    );
    if (numbers.focal_px > 0) return { focal_px: numbers.focal_px };
    if (numbers.focal_mm > 0 && numbers.sensor_mm > 0) return {
      focal_mm: numbers.focal_mm,
      sensor_mm: numbers.sensor_mm,
    };
    return null;
  };
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    const camera = wanted();
    if (!camera) return fail("Give the focal length in pixels; or in millimetres together with the sensor's width.");
    try {
      await ask("set_camera", { photo: store.shown(), ...camera });
      done();
    } catch (error) {
      fail(error.message);
    }
  });
  file.addEventListener("change", async () => {
    const [chosen] = file.files;
    file.value = "";
    if (!chosen) return;
    try {
      await sendFile(chosen, { what: "camera", photo: store.shown() }).finished;
      done();
    } catch (error) {
      fail(error.message);
    }
  });

  const show = () => {
    const photo = store.photo();
    const camera = photo?.camera;
    const said = camera
      ? `${photo.name}: ${camera.said || `f ${fixed(camera.fx, 1)} px`}`
      : `Nothing in ${photo?.name ?? "the file"} tells its focal length.`;
    put(head, said);
    px.input.placeholder = camera ? fixed(camera.fx, 1) : "1000";
  };
  const asked = new Set();
  const askOnce = () => {
    const photo = store.photo();
    if (!photo || photo.camera || photo.error || asked.has(photo.id)) return;
    if (opener.hidden || document.querySelector("dialog[open], [popover]:popover-open")) return;
    asked.add(photo.id); // who puts it away finds it at the tab
    panel.showPopover();
  };
  store.watch(["photos", "shown"], () => {
    show();
    requestAnimationFrame(askOnce);
  });
  document.addEventListener("close", () => requestAnimationFrame(askOnce), true); // of a dialog that stood before it
  panel.addEventListener("toggle", (event) => event.newState === "open" && (fail(""), show(), px.input.focus()));
};
