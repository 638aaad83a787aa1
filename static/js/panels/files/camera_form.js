/** The form for the camera of a photograph: 35 mm equivalent, lens and sensor, pixels, or a camera file. */

import { ask } from "../../net/connection.js";
import { store } from "../../net/store.js";
import { sendFile } from "../../net/uploads.js";
import { button } from "../../ui/controls.js";
import { element, newId, partOf, setAttribute, setChildren, setText } from "../../ui/dom.js";
import { fieldOf, messageOf } from "../../ui/faults.js";
import { sentences } from "../../ui/numbers.js";
import { opens, popoverOf } from "../../ui/popover.js";

/** @typedef {import("../../net/requests.js").Commands} Commands */

const EMPTY = "Fill in one of the three: the 35 mm equivalent, or focal length and sensor width, or pixels.";

const FORM_PX = 350;
const MARGIN_PX = 8;

/** @param {string} label @param {string} unit @param {string} example */
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

/**
 * One way to specify the focal length, with its source.
 * @param {string} source
 * @param {...ReturnType<typeof field>} fields
 */
const option = (source, ...fields) =>
  element("fieldset", {}, ...fields.map(({ row }) => row), element("p", { class: "dim field-source" }, source));

/** Attach the form to its button. @param {HTMLButtonElement} opener */
export const mountCameraForm = (opener) => {
  const film = field("35 mm equivalent", "mm", "26");
  film.input.autofocus = true;
  const mm = field("Focal length", "mm", "5.6");
  const sensor = field("Sensor width", "mm", "7.3");
  const px = field("Focal length in pixels", "px", "1000");
  /** @type {Record<string, ReturnType<typeof field>>} */
  const fields = { focal_35mm: film, focal_mm: mm, sensor_mm: sensor, focal_px: px };
  const head = element("p", { class: "form-head" });
  const wrong = element("p", { class: "form-wrong", role: "alert", hidden: true });
  const file = element(
    "input",
    { type: "file", accept: ".json,.yaml,.yml,.xml,.txt,.bin", class: "visually-hidden", tabIndex: -1, "aria-hidden": "true" },
  );
  const or = () => element("p", { class: "or" }, "or");
  const form = element(
    "form",
    { class: "camera-form", noValidate: true },
    head,
    option("Shown by phones and most cameras in the details of the original photograph.", film),
    or(),
    option("Sensor width from the camera's data sheet; an empty focal length is that of the photograph's EXIF.", mm, sensor),
    or(),
    option("From a camera calibration at this picture size.", px),
    wrong,
    element(
      "div",
      { class: "form-foot" },
      button({
        label: "It is a panorama",
        title: "The photograph is a panorama of the whole sphere (equirectangular, twice as wide as high)",
        act: () => apply({ model: "equirectangular" }),
      }),
      button({
        label: "Camera file…",
        icon: "file",
        title: "Camera file: JSON, OpenCV, ROS, Kalibr, COLMAP, nerfstudio or Agisoft",
        act: () => file.click(),
      }),
      element("button", { class: "button primary", type: "submit" }, "Apply"),
    ),
    file,
  );
  const panel = popoverOf(opener, "Camera of the photograph", form);
  /** @param {string} text @param {{input?: HTMLInputElement}} where */
  const fail = (text, { input } = {}) => {
    setText(wrong, text);
    wrong.hidden = text === "";
    for (const each of Object.values(fields)) setAttribute(each.input, "aria-invalid", each.input === input);
    input?.focus();
  };
  const done = () => {
    for (const { input } of Object.values(fields)) input.value = "";
    fail("");
    panel.hidePopover();
  };

  /** @param {string} text @param {{input?: HTMLInputElement}} where @returns {null} */
  const refuse = (text, where) => {
    fail(text, where);
    return null;
  };
  /** @returns {Record<string, number> | null} the values; null if they are incomplete, which is then shown */
  const read = () => {
    const filled = Object.entries(fields).filter(([, { input }]) => input.value.trim() !== "");
    const numbers = Object.fromEntries(filled.map(([name, { input }]) => [name, numberOf(input.value)]));
    const [, bad] = filled.find(([name]) => !(numbers[name] > 0 && numbers[name] < Infinity)) ?? [];
    if (bad) return refuse(`${bad.label}: “${bad.input.value.trim().slice(0, 20)}” is not a number above 0.`, bad);
    if ("focal_mm" in numbers && !("sensor_mm" in numbers)) {
      return refuse(`${sensor.label} is missing: focal length and sensor width belong together.`, sensor);
    }
    const options = new Set(filled.map(([name]) => (name === "sensor_mm" ? "focal_mm" : name)));
    if (options.size === 0) return refuse(EMPTY, film);
    if (options.size > 1) return refuse("More than one is filled in: clear all but one.", filled[0][1]);
    return numbers;
  };
  const apply = async (/** @type {Omit<Commands["set_camera"], "photo">} */ camera) => {
    const photo = store.shown();
    if (!photo) return;
    try {
      await ask("set_camera", { photo, ...camera });
      done();
    } catch (error) {
      fail(sentences([messageOf(error)]), fields[fieldOf(error)]);
    }
  };
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    const camera = read();
    if (camera) apply(camera);
  });
  file.addEventListener("change", async () => {
    const chosen = file.files?.[0];
    file.value = "";
    if (!chosen) return;
    try {
      await sendFile(chosen, { what: "camera", photo: store.shown() }).finished;
      done();
    } catch (error) {
      fail(messageOf(error));
    }
  });

  const show = () => {
    const photo = store.photo();
    const camera = photo?.camera;
    const text = camera
      ? `${photo.name}: ${camera.said}`
      : `${photo?.name ?? "The file"} has no focal length: enter it in one of these ways.`;
    setChildren(head, text);
  };
  const offered = new Set();
  const offerOnce = () => {
    const photo = store.photo();
    if (!photo || photo.camera || photo.error || offered.has(photo.id)) return;
    if (opener.hidden || document.querySelector("dialog[open], [popover]:popover-open")) return;
    offered.add(photo.id); // once it is closed, the button beside the tab opens it again
    panel.showPopover();
  };
  store.watch(["photos", "shown"], () => {
    show();
    requestAnimationFrame(offerOnce);
  });
  document.addEventListener("close", () => requestAnimationFrame(offerOnce), true); // when the dialog over it closes
  panel.addEventListener("beforetoggle", (event) => {
    if (!opens(event)) return;
    fail("");
    show();
    overPhoto(panel);
  });
};

/**
 * Move the form over the picture that it is about, off the controls of the scan, where there is room.
 * @param {HTMLElement} panel
 */
const overPhoto = (panel) => {
  const { left, width } = partOf(document, "#photo-pane .pane-body").getBoundingClientRect();
  if (width < FORM_PX || panel.style.left === "auto" || Number.parseFloat(panel.style.left) >= left) return;
  panel.style.setProperty("left", `${left + MARGIN_PX}px`);
};

/** @param {string} text @returns {number} the number in a text with a decimal point or comma; NaN if there is none */
const numberOf = (text) => Number(text.trim().replace(",", "."));
