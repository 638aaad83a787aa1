/** Telling the focal length of a photograph: as phones tell it, as the lens tells it, in pixels, or by a camera file. */

import { attribute, button, element, newId, put, say } from "../ui/dom.js";
import { ask } from "../net/connection.js";
import { fixed, sentences } from "../ui/numbers.js";
import { popoverOf } from "../ui/popover.js";
import { sendFile } from "../net/uploads.js";
import { store } from "../net/store.js";

const NOTHING = "Fill in one of the three: the 35 mm equivalent, or focal length and sensor width, or pixels.";

const field = (label, unit, example) => {
  const id = newId("field");
  const input = element("input", {
    id,
    type: "text",
    inputMode: "decimal",
    autocomplete: "off",
    placeholder: example,
    class: "number",
  });
  return {
    label,
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

/** One way to tell it, and where it is found. */
const way = (where, ...fields) =>
  element("fieldset", {}, ...fields.map(({ row }) => row), element("p", { class: "dim field-where" }, where));

/** @param {HTMLButtonElement} opener */
export const mountCameraForm = (opener) => {
  const film = field("35 mm equivalent", "mm", "26");
  film.input.autofocus = true;
  const mm = field("Focal length", "mm", "5.6");
  const sensor = field("Sensor width", "mm", "7.3");
  const px = field("Focal length in pixels", "px", "1000");
  const fields = { focal_35mm: film, focal_mm: mm, sensor_mm: sensor, focal_px: px };
  const head = element("p", { class: "form-head" });
  const wrong = element("p", { class: "form-wrong", role: "alert", hidden: true });
  const file = element(
    "input",
    { type: "file", accept: ".json,.yaml,.yml,.xml", class: "told", tabIndex: -1, "aria-hidden": "true" },
  );
  const or = () => element("p", { class: "or" }, "or");
  const form = element(
    "form",
    { class: "camera-form", noValidate: true },
    head,
    way("Phones and most cameras tell it in the details of the original photograph.", film),
    or(),
    way("From the lens, and the width of the sensor from the camera's data sheet.", mm, sensor),
    or(),
    way("From a calibration of the camera at this picture size.", px),
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
  const fail = (text, { input } = {}) => {
    say(wrong, text);
    wrong.hidden = text === "";
    for (const each of Object.values(fields)) attribute(each.input, "aria-invalid", each.input === input);
    input?.focus();
  };
  const done = () => {
    for (const { input } of Object.values(fields)) input.value = "";
    fail("");
    panel.hidePopover();
  };

  const refuse = (text, where) => {
    fail(text, where);
    return null;
  };
  /** @returns {Record<string, number> | null} what was filled in; null where something is to be said first */
  const wanted = () => {
    const filled = Object.entries(fields).filter(([, { input }]) => input.value.trim() !== "");
    const numbers = Object.fromEntries(filled.map(([name, { input }]) => [name, numberOf(input.value)]));
    const [, bad] = filled.find(([name]) => !(numbers[name] > 0 && numbers[name] < Infinity)) ?? [];
    if (bad) return refuse(`${bad.label}: “${bad.input.value.trim().slice(0, 20)}” is no number above 0.`, bad);
    if ("focal_mm" in numbers !== "sensor_mm" in numbers) {
      const missing = "focal_mm" in numbers ? sensor : mm;
      return refuse(`${missing.label} is missing: the two belong together.`, missing);
    }
    const ways = new Set(filled.map(([name]) => (name === "sensor_mm" ? "focal_mm" : name)));
    if (ways.size === 0) return refuse(NOTHING, film);
    if (ways.size > 1) return refuse("More than one is filled in: empty all but one.", filled[0][1]);
    return numbers;
  };
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    const camera = wanted();
    if (!camera) return;
    try {
      await ask("set_camera", { photo: store.shown(), ...camera });
      done();
    } catch (error) {
      fail(sentences([error.message]));
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
      : `${photo?.name ?? "The file"} does not tell its focal length: say it in one of these ways.`;
    put(head, said);
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
  panel.addEventListener("beforetoggle", (event) => event.newState === "open" && (fail(""), show()));
};

/** @returns {number} of a text with a decimal point or comma; NaN where it is none */
const numberOf = (text) => Number(text.trim().replace(",", "."));
