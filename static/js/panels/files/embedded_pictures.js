/** Pictures embedded in the scan's file: offered as photographs, never added by themselves. */

import { request } from "../../net/requests.js";
import { store } from "../../net/store.js";
import { button } from "../../ui/controls.js";
import { element, setChildren, setText } from "../../ui/dom.js";
import { icon } from "../../ui/icons.js";

/** @typedef {import("../../protocol.d.ts").EmbeddedPicture} Embedded */

/** @returns {Embedded[]} */
const embedded = () => store.get("embedded") ?? [];

/** @returns {Embedded[]} the pictures that are not yet photographs of the project, and may become some */
export const offeredPictures = () => embedded().filter(({ usable, taken }) => usable && !taken);

const add = (/** @type {number[]} */ images) => request("add_embedded", { images });

/** @param {Embedded} picture */
const rowOf = ({ index, name, said, usable, taken }) =>
  element(
    "li",
    { class: "file-row embedded-picture" },
    icon("file"),
    element("span", { class: "clip", title: name }, name),
    usable && !taken
      ? button({ label: `Add ${name}`, text: "Add as photograph", kind: "small", act: () => add([index]) })
      : element("span", { class: "dim" }, taken ? "Added" : "Cannot be used"),
    element("span", { class: "file-status" }, said),
  );

/** @returns {HTMLElement} the list, hidden where the scan has no pictures */
export const embeddedList = () => {
  const title = element("h3", {});
  const list = element("ul", { class: "file-list", "aria-label": "Pictures in the scan" });
  const all = button({ label: "Add all", kind: "small", act: () => add(offeredPictures().map(({ index }) => index)) });
  const section = element("section", { class: "served" }, element("div", { class: "row" }, title, all), list);
  const show = () => {
    const images = embedded();
    section.hidden = images.length === 0;
    setText(title, `Pictures in ${store.get("scan")?.name ?? "the scan"}`);
    all.hidden = offeredPictures().length < 2;
    setChildren(list, ...images.map(rowOf));
  };
  store.watch(["embedded", "scan"], show);
  show();
  return section;
};
