/** Uploaded files that are not open yet: what they lack, or what the operator has to choose. */

import { request } from "../../net/requests.js";
import { store } from "../../net/store.js";
import { button } from "../../ui/controls.js";
import { element, partOf, setChildren, setText } from "../../ui/dom.js";
import { icon } from "../../ui/icons.js";
import { bytes } from "../../ui/numbers.js";
import { labelOf } from "./file_kinds.js";
import { readingForm } from "./reading_form.js";

/**
 * @typedef {import("../../protocol.d.ts").WaitingFile} Waiting
 * @typedef {(ids: string[], choice: object) => void} Open
 */

const NEEDS_PHOTO = new Set(["camera", "matches"]);
const OPENS = new Set(["scan", "photo"]);

/** @param {string} text */
const sentence = (text) => `${text.charAt(0).toUpperCase()}${text.slice(1).replace(/\.$/u, "")}.`;

/** @param {Waiting} file @returns {HTMLSelectElement} */
const photoChoice = ({ name }) => {
  const photos = store.photos();
  return element(
    "select",
    { "aria-label": `Photograph of ${name}` },
    ...photos.map((photo) => element("option", { value: photo.id, selected: photo.id === store.shown() }, photo.name)),
  );
};

/** @param {Waiting} file */
const removal = ({ id, name }) =>
  button({
    label: `Remove ${name}`,
    icon: "close",
    bare: true,
    kind: "plain small edits",
    act: () => request("discard_files", { files: [id] }),
  });

/**
 * A scan whose file does not say all that reading it needs, with a form for it.
 * @param {Waiting} file
 * @param {Open} open
 */
const underspecifiedRow = (file, open) => {
  const { id, name, size, said, takes, scans } = file;
  const form = readingForm(takes, (reading) => open([id], { reading }), scans);
  return element(
    "li",
    { class: "file-row waiting-file" },
    icon("file"),
    element("span", { class: "clip", title: name }, name),
    element("span", { class: "dim figures" }, bytes(size)),
    element("span", {}),
    removal(file),
    element("span", { class: "file-status" }, sentence(said)),
    form,
  );
};

/** @param {Waiting} file @param {Open} open */
const rowOf = (file, open) => {
  const { id, name, size, kind, said, lacks, takes } = file;
  if (takes.length) return underspecifiedRow(file, open);
  const choice = NEEDS_PHOTO.has(kind) && store.photos().length && store.get("scan") ? photoChoice(file) : null;
  const opens = (OPENS.has(kind) && !lacks.length) || choice;
  return element(
    "li",
    { class: "file-row waiting-file" },
    icon("file"),
    element("span", { class: "clip", title: name }, name),
    element("span", { class: "dim figures" }, bytes(size)),
    element(
      "span",
      { class: "row" },
      choice,
      opens
        ? button({ label: `Open as ${labelOf(kind)}`, kind: "small edits", act: () => open([id], choice ? { photo: choice.value } : {}) })
        : null,
    ),
    removal(file),
    element("span", { class: "file-status" }, sentence(said)),
  );
};

/**
 * @param {(ids: string[], choice: object) => void} open opens files of the list
 * @returns {HTMLElement} the list, hidden while it is empty
 */
export const waitingList = (open) => {
  const list = element("ul", { class: "file-list", "aria-label": "Files that wait" });
  /** @type {string[]} */
  let scans = [];
  const together = button({ label: "Open together", kind: "small edits", act: () => open(scans, {}) });
  const head = element("div", { class: "row" }, element("h3", {}, "Not open yet"), together);
  const section = element("section", { class: "waiting-files" }, head, list);
  let drawn = "";
  const show = () => {
    /** @type {Waiting[]} */
    const files = store.get("waiting") ?? [];
    const text = JSON.stringify([files, store.photos().map(({ id, name }) => [id, name]), Boolean(store.get("scan"))]);
    if (text === drawn) return;
    drawn = text;
    section.hidden = files.length === 0;
    scans = files.filter(({ kind, lacks }) => kind === "scan" && !lacks.length).map(({ id }) => id);
    together.hidden = scans.length < 2;
    setText(partOf(together, "span"), `Open ${scans.length} scans together`);
    setChildren(list, ...files.map((file) => rowOf(file, open)));
  };
  store.watch(["waiting", "photos", "scan"], show);
  show();
  return section;
};
