/** Files may be dropped anywhere on the page; while they hang over it, the page says what it will do. */

import { element } from "../ui/dom.js";
import { takeFiles } from "./files.js";
import { icon } from "../ui/icons.js";
import { notice } from "../ui/notices.js";

const hasFiles = (event) => [...(event.dataTransfer?.types ?? [])].includes("Files");

/** @returns {Set<string>} names of the folders among what was dropped: they look like files that cannot be read */
const foldersOf = ({ items }) =>
  new Set([...items].map((item) => item.webkitGetAsEntry?.()).filter((entry) => entry?.isDirectory).map(({ name }) => name));

/** @param {HTMLElement} floating */
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
        "A scan takes the place of the open one, photographs are added. Each step can be undone.",
      ),
    ),
  );
  floating.append(veil);
  let deep = 0;
  const show = (shown) => {
    veil.hidden = !shown || document.querySelector("dialog[open]") !== null;
    document.body.classList.toggle("dropping", shown);
    if (!shown) deep = 0;
  };
  addEventListener("dragenter", (event) => hasFiles(event) && (event.preventDefault(), (deep += 1), show(true)));
  addEventListener("dragleave", (event) => hasFiles(event) && --deep <= 0 && show(false));
  addEventListener(
    "dragover",
    (event) => hasFiles(event) && (event.preventDefault(), (event.dataTransfer.dropEffect = "copy")),
  );
  addEventListener("drop", (event) => {
    if (!hasFiles(event)) return;
    event.preventDefault();
    show(false);
    const folders = foldersOf(event.dataTransfer);
    for (const name of folders) notice(`${name} is a folder: drop the files in it.`, "warn");
    const files = [...event.dataTransfer.files].filter(({ name }) => !folders.has(name));
    if (files.length) takeFiles(files);
  });
};
