/** The photographs as tabs; each person sees the one that he or she chose. */

import { request } from "../net/requests.js";
import { store } from "../net/store.js";
import { button } from "../ui/controls.js";
import { element, scrollAcross, setChildren } from "../ui/dom.js";
import { icon } from "../ui/icons.js";
import { lightOf } from "../ui/lights.js";
import { notice } from "../ui/notices.js";
import { markChosen, navigateByArrows } from "../ui/tablist.js";
import { mountCameraForm } from "./camera_form.js";
import { openFiles } from "./files.js";

const stateOf = (photo) => {
  if (photo.error) return { sign: "bad", word: photo.error, level: "bad" };
  if (!photo.camera) return { sign: "warn", word: "focal length unknown", level: "warn" };
  return { ...lightOf(photo.light), word: photo.light_words ?? "not solved yet" };
};

const remove = async (photo) => {
  const removed = await request("remove_photo", { photo: photo.id });
  if (removed) notice(
    `${photo.name} was removed from the project.`,
    "info",
    { label: "Undo", act: () => request("undo", { n: removed.n }) },
  );
};

/** @returns {HTMLElement} */
export const mountPhotoTabs = () => {
  const list = element("div", { class: "photo-tabs", role: "tablist", "aria-label": "Photographs" });
  const add = button({
    label: "Add photographs",
    icon: "plus",
    bare: true,
    kind: "small edits",
    act: () => openFiles("photo"),
  });
  const discard = button({
    label: "Remove this photograph from the project",
    icon: "close",
    bare: true,
    kind: "plain small edits",
  });
  const camera = button({ label: "Camera", icon: "warn", kind: "small camera-button edits" });
  const shelf = element("div", { class: "photo-shelf" }, list, discard, camera, add);
  navigateByArrows(list);
  discard.addEventListener("click", () => store.photo() && remove(store.photo()));
  mountCameraForm(camera);
  let drawn = "";

  const tab = (photo) => {
    const { sign, word, level } = stateOf(photo);
    const chip = element(
      "button",
      {
        type: "button",
        class: "chip photo-tab",
        role: "tab",
        "aria-controls": "photo-pane",
        title: `${photo.name}: ${word}${photo.stale ? ` (${photo.stale})` : ""}${photo.thermal ? ", thermal" : ""}\n` +
          `${photo.camera ? [photo.camera.said, ...(photo.notes ?? [])].filter(Boolean).join("\n") : ""}`,
      },
      element("span", { class: `sign ${level}` }, icon(sign)),
      element("span", { class: "clip" }, photo.name),
      element("span", { class: "visually-hidden" }, `, ${word}`),
    );
    chip.dataset.photo = photo.id;
    chip.addEventListener("click", () => photo.id !== store.shown() && request("show_photo", { photo: photo.id }));
    chip.addEventListener("keydown", (event) => event.key === "Delete" && remove(photo));
    return chip;
  };

  const show = () => {
    const photos = store.get("photos") ?? [];
    const text = JSON.stringify(photos);
    if (text !== drawn) {
      const focused = list.contains(document.activeElement) ? document.activeElement.dataset.photo : null;
      setChildren(list, ...photos.map(tab));
      drawn = text;
      if (focused) [...list.children].find(({ dataset }) => dataset.photo === focused)?.focus();
    }
    const chosen = [...list.children].find(({ dataset }) => dataset.photo === store.shown());
    markChosen([...list.children], chosen);
    const shown = store.photo();
    discard.hidden = !shown;
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
    const full = photos.length >= (store.get("limits")?.photos ?? Infinity);
    add.disabled = full;
    add.title = full ? `A project has at most ${store.get("limits").photos} photographs` : "Add photographs";
    setChildren(add, icon("plus"), photos.length ? null : element("span", {}, "Photograph"));
    add.classList.toggle("bare", photos.length > 0);
    add.classList.toggle("attention", photos.length === 0 && Boolean(store.get("scan")));
    if (chosen) scrollAcross(list, chosen); // after everything beside it has its final width
  };
  store.watch(["photos", "shown", "scan", "limits"], show);
  show();
  return shelf;
};
