/** The photographs as tabs; the shown one is the one that all look at. */

import { button, element, put } from "../ui/dom.js";
import { wish } from "../net/requests.js";
import { openFiles } from "./files.js";
import { icon } from "../ui/icons.js";
import { mountCameraForm } from "./camera_form.js";
import { notice } from "../ui/notices.js";
import { store } from "../net/store.js";
import { choose, walkByArrows } from "../ui/tablist.js";

const SIGNS = { empty: "dot", solved: "target", accepted: "tick", refused: "bad" };
const WORDS = { empty: "not solved yet", solved: "solved", accepted: "accepted", refused: "not accepted" };

const stateOf = (photo) => {
  if (photo.error) return { sign: "bad", word: photo.error, level: "bad" };
  if (!photo.camera) return { sign: "warn", word: "its focal length is not known", level: "warn" };
  const level = { accepted: "ok", refused: "bad", solved: "accent" }[photo.state] ?? "dim";
  return { sign: SIGNS[photo.state] ?? "dot", word: WORDS[photo.state] ?? photo.state, level };
};

const remove = async (photo) => {
  const removed = await wish("remove_photo", { photo: photo.id });
  if (removed) notice(
    `${photo.name} was taken out of the project.`,
    "info",
    { label: "Undo", act: () => wish("undo") },
  );
};

/** @returns {HTMLElement} */
export const mountPhotoTabs = () => {
  const list = element("div", { class: "photo-tabs", role: "tablist", "aria-label": "Photographs" });
  const add = button({
    label: "Add photographs",
    icon: "plus",
    bare: true,
    kind: "small",
    act: () => openFiles("photo"),
  });
  const away = button({
    label: "Take this photograph out of the project",
    icon: "close",
    bare: true,
    kind: "plain small",
  });
  const camera = button({ label: "Camera", icon: "warn", kind: "small camera-button" });
  const shelf = element("div", { class: "photo-shelf" }, list, away, camera, add);
  walkByArrows(list);
  away.addEventListener("click", () => store.photo() && remove(store.photo()));
  mountCameraForm(camera);
  let drawn = "";

  const tab = (photo) => {
    const { sign, word, level } = stateOf(photo);
    const made = element(
      "button",
      {
        type: "button",
        class: "chip photo-tab",
        role: "tab",
        "aria-controls": "photo-pane",
        title: `${photo.name}: ${word}${photo.thermal ? ", thermal" : ""}\n` +
          `${photo.camera ? [photo.camera.said, ...(photo.notes ?? [])].filter(Boolean).join("\n") : ""}`,
      },
      element("span", { class: `sign ${level}` }, icon(sign)),
      element("span", { class: "clip" }, photo.name),
      element("span", { class: "told" }, `, ${word}`),
    );
    made.dataset.photo = photo.id;
    made.addEventListener("click", () => photo.id !== store.shown() && wish("show_photo", { photo: photo.id }));
    made.addEventListener("keydown", (event) => event.key === "Delete" && remove(photo));
    return made;
  };

  const show = () => {
    const photos = store.get("photos") ?? [];
    const text = JSON.stringify(photos);
    if (text !== drawn) {
      const focused = list.contains(document.activeElement) ? document.activeElement.dataset.photo : null;
      put(list, ...photos.map(tab));
      drawn = text;
      if (focused) [...list.children].find(({ dataset }) => dataset.photo === focused)?.focus();
    }
    const chosen = [...list.children].find(({ dataset }) => dataset.photo === store.shown());
    choose([...list.children], chosen);
    const shown = store.photo();
    away.hidden = !shown;
    camera.hidden = !shown || Boolean(shown.error);
    put(
      camera,
      icon(shown?.camera ? "target" : "warn"),
      element("span", { class: "figures" }, shown?.camera ? `f ${Math.round(shown.camera.fx)}` : "Focal length"),
    );
    camera.classList.toggle("wanted", Boolean(shown && !shown.camera));
    camera.title = shown?.camera
      ? `Camera of ${shown.name}: ${shown.camera.said ?? ""}`
      : "The focal length is not known: tell it here";
    camera.setAttribute("aria-label", shown?.camera ? "Camera of the photograph" : "Tell the focal length");
    const full = photos.length >= (store.get("limits")?.photos ?? Infinity);
    add.disabled = full;
    add.title = full ? `A project holds at most ${store.get("limits").photos} photographs` : "Add photographs";
    put(add, icon("plus"), photos.length ? null : element("span", {}, "Photograph"));
    add.classList.toggle("bare", photos.length > 0);
    add.classList.toggle("wanted", photos.length === 0 && Boolean(store.get("scan")));
    chosen?.scrollIntoView({ block: "nearest", inline: "nearest" }); // now that all beside it has its width
  };
  store.watch(["photos", "shown", "scan", "limits"], show);
  show();
  return shelf;
};
