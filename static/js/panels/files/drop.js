/** Dropping files anywhere on the page, with an explanation while they are over it. */

import { element } from "../../ui/dom.js";
import { icon } from "../../ui/icons.js";
import { notice } from "../../ui/notices.js";
import { addFiles } from "./files.js";

/** @param {DragEvent} event @returns {DataTransfer | null} what is dragged, if it is files */
const filesOf = ({ dataTransfer }) => (dataTransfer && [...dataTransfer.types].includes("Files") ? dataTransfer : null);

/** @param {DataTransfer} dropped @returns {Set<string>} names of dropped folders, which look like unreadable files */
const foldersOf = ({ items }) => {
  const entries = [...items].map((item) => item.webkitGetAsEntry?.());
  return new Set(entries.flatMap((entry) => (entry?.isDirectory ? entry.name : [])));
};

/** Accept dropped files. @param {HTMLElement} floating contains the explanation */
export const acceptDrops = (floating) => {
  const veil = element(
    "div",
    { class: "drop-veil", hidden: true },
    element(
      "div",
      { class: "drop-zone" },
      icon("download"),
      element("p", { class: "drop-title" }, "Drop to open"),
      element(
        "p",
        { class: "dim" },
        "Files that belong together are opened together; names and endings do not matter. Each step can be undone.",
      ),
    ),
  );
  floating.append(veil);
  let depth = 0;
  /** @param {boolean} shown */
  const show = (shown) => {
    veil.hidden = !shown || document.querySelector("dialog[open]") !== null;
    document.body.classList.toggle("dropping", shown);
    if (!shown) depth = 0;
  };
  addEventListener("dragenter", (event) => filesOf(event) && (event.preventDefault(), (depth += 1), show(true)));
  addEventListener("dragleave", (event) => filesOf(event) && --depth <= 0 && show(false));
  addEventListener("dragover", (event) => {
    const dragged = filesOf(event);
    if (!dragged) return;
    event.preventDefault();
    dragged.dropEffect = "copy";
  });
  addEventListener("drop", (event) => {
    const dropped = filesOf(event);
    if (!dropped) return;
    event.preventDefault();
    show(false);
    const folders = foldersOf(dropped);
    for (const name of folders) notice(`${name} is a folder: drop the files in it.`, "warn");
    const files = [...dropped.files].filter(({ name }) => !folders.has(name));
    if (files.length) addFiles(files);
  });
};
