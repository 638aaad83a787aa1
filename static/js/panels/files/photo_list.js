/** The photographs: a button that names the shown one, and the list of all below it. Each person sees the one that he or she chose. */

import { request } from "../../net/requests.js";
import { store } from "../../net/store.js";
import { button } from "../../ui/controls.js";
import { element, setChildren, setText } from "../../ui/dom.js";
import { icon } from "../../ui/icons.js";
import { lightOf } from "../../ui/lights.js";
import { notice } from "../../ui/notices.js";
import { counted } from "../../ui/numbers.js";
import { popoverOf } from "../../ui/popover.js";
import { thumbnail } from "../../ui/thumbnail.js";
import { mountCameraForm } from "./camera_form.js";
import { openFiles } from "./files.js";

/** @typedef {import("../../net/store.js").Photo} Photo */

/** @param {Photo} photo */
const stateOf = (photo) => {
  if (photo.error) return { sign: "bad", word: photo.error, level: "bad" };
  if (!photo.camera) return { sign: "warn", word: "focal length unknown", level: "warn" };
  return { ...lightOf(photo.light), word: photo.light_words ?? "not solved yet" };
};

/** @param {Photo} photo */
const aboutOf = (photo) => {
  const notes = photo.camera ? [photo.camera.said, ...(photo.notes ?? [])] : [];
  const state = `${stateOf(photo).word}${photo.stale ? ` (${photo.stale})` : ""}${photo.thermal ? ", thermal" : ""}`;
  return [`${photo.name}: ${state}`, ...notes].filter(Boolean).join("\n");
};

/** @param {Photo} photo */
const remove = async (photo) => {
  const removed = await request("remove_photo", { photo: photo.id });
  if (removed) notice(
    `${photo.name} was removed from the project.`,
    "info",
    { label: "Undo", act: () => request("undo", { n: removed.n }) },
  );
};

/** One photograph in the list. @param {Photo} photo @param {() => void} close */
const entry = (photo, close) => {
  const { sign, word, level } = stateOf(photo);
  const words = [word, photo.position && `± ${photo.position}`].filter(Boolean).join(", ");
  const choose = element(
    "button",
    {
      type: "button",
      class: "photo-entry",
      title: aboutOf(photo),
      "aria-current": photo.id === store.shown() ? "true" : null,
      on: {
        click: () => {
          if (photo.id !== store.shown()) request("show_photo", { photo: photo.id });
          close();
        },
      },
    },
    thumbnail(photo),
    element(
      "span",
      { class: "photo-text" },
      element("span", { class: "clip" }, photo.name),
      element("span", { class: `photo-state clip ${level}` }, icon(sign), " ", words),
    ),
  );
  choose.dataset.photo = photo.id;
  const discard = button({
    label: `Remove ${photo.name} from the project`,
    icon: "close",
    bare: true,
    kind: "plain small edits",
    act: () => remove(photo),
  });
  return element("li", {}, choose, discard);
};

/** Let the arrow keys, Home and End walk through the list, and Delete remove from it. @param {HTMLElement} list */
const navigate = (list) => {
  list.addEventListener("keydown", (event) => {
    /** @type {NodeListOf<HTMLElement>} */
    const found = list.querySelectorAll(".photo-entry");
    const entries = [...found];
    const at = entries.findIndex((each) => each === document.activeElement);
    if (at < 0) return;
    const next = new Map([["ArrowDown", at + 1], ["ArrowUp", at - 1], ["Home", 0], ["End", entries.length - 1]]).get(event.key);
    if (next !== undefined) {
      event.preventDefault();
      entries[(next + entries.length) % entries.length].focus();
    } else if (event.key === "Delete") {
      const photo = store.photos().find(({ id }) => id === entries[at].dataset.photo);
      if (photo) remove(photo);
    }
  });
};

/** @returns {HTMLElement} */
export const mountPhotoList = () => {
  const opener = button({ label: "Photographs", kind: "chip photo-button" });
  const list = element("ul", { class: "photo-list" });
  const add = button({ label: "Add photographs", icon: "plus", kind: "small edits", act: () => openFiles("photo") });
  const total = element("h2");
  const panel = popoverOf(opener, "Photographs", element("div", { class: "row" }, total, element("span", { class: "end" }, add)), list);
  panel.classList.add("photo-panel");
  const first = button({ label: "Photograph", icon: "plus", kind: "small edits", title: "Add photographs", act: () => openFiles("photo") });
  const camera = button({ label: "Camera", icon: "warn", kind: "small camera-button edits" });
  const shelf = element("div", { class: "photo-shelf" }, opener, panel, camera, first);
  navigate(list);
  mountCameraForm(camera);
  let drawn = "";

  const showList = () => {
    const photos = store.photos();
    const text = JSON.stringify([photos, store.shown()]);
    if (!panel.matches(":popover-open") || text === drawn) return;
    const active = /** @type {HTMLElement | null} */ (document.activeElement);
    const focused = active && list.contains(active) ? active.dataset.photo : null;
    setChildren(list, ...photos.map((photo) => entry(photo, () => panel.hidePopover())));
    drawn = text;
    if (!focused) return;
    /** @type {HTMLElement | null} */
    const again = list.querySelector(`[data-photo="${CSS.escape(focused)}"]`);
    again?.focus();
  };
  panel.addEventListener("toggle", () => {
    showList();
    if (panel.matches(":popover-open")) list.querySelector("[aria-current=true]")?.scrollIntoView({ block: "nearest" });
  });

  const show = () => {
    const photos = store.photos(), shown = store.photo(), most = store.get("limits")?.photos ?? Infinity;
    opener.hidden = photos.length === 0;
    first.hidden = photos.length > 0;
    first.classList.toggle("attention", Boolean(store.get("scan")));
    setText(total, counted(photos.length, "photograph"));
    add.disabled = photos.length >= most;
    add.title = add.disabled ? `A project has at most ${most} photographs` : "Add photographs";
    if (shown) {
      const { sign, word, level } = stateOf(shown);
      setChildren(
        opener,
        element("span", { class: `sign ${level}` }, icon(sign)),
        element("span", { class: "clip photo-name" }, shown.name),
        element("span", { class: "visually-hidden" }, `, ${word}`),
        photos.length > 1
          ? element("span", { class: "dim figures" }, `${photos.findIndex(({ id }) => id === shown.id) + 1}/${photos.length}`)
          : null,
        icon("more"),
      );
      opener.title = `${aboutOf(shown)}\nClick for all photographs, to add and to remove them.`;
    }
    camera.hidden = !shown || Boolean(shown.error);
    setChildren(
      camera,
      icon(shown?.camera ? "target" : "warn"),
      element("span", { class: "figures" }, shown?.camera ? shown.camera.short : "Focal length"),
    );
    camera.classList.toggle("attention", Boolean(shown && !shown.camera));
    camera.title = shown?.camera
      ? `Camera of ${shown.name}: ${shown.camera.said ?? ""}`
      : "The focal length is unknown: enter it here";
    camera.setAttribute("aria-label", shown?.camera ? "Camera of the photograph" : "Enter the focal length");
    showList();
  };
  store.watch(["photos", "shown", "scan", "limits"], show);
  show();
  return shelf;
};
