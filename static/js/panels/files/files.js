/** The dialog for opening files: dropped, chosen, or from the served folder. */

import { request } from "../../net/requests.js";
import { store } from "../../net/store.js";
import { sendFile } from "../../net/uploads.js";
import { button } from "../../ui/controls.js";
import { makeDialog } from "../../ui/dialog.js";
import { element, newId, partOf, setChildren, setText } from "../../ui/dom.js";
import { messageOf, wasCancelled } from "../../ui/faults.js";
import { icon } from "../../ui/icons.js";
import { notice } from "../../ui/notices.js";
import { bytes } from "../../ui/numbers.js";
import { confirmation } from "./confirmation.js";
import { embeddedList, offeredPictures } from "./embedded_pictures.js";
import { accepted, labelOf, readable } from "./file_kinds.js";
import { ABOUT_FRAMES, scanClouds } from "./scan_clouds.js";
import { scanQuestion } from "./scan_question.js";
import { waitingList } from "./waiting_files.js";

const OPENABLE = new Set(["scan", "photo", "camera", "matches"]);
const NEEDS_PHOTO = new Set(["camera", "matches"]);

/** @type {Record<string, string>} */
const TITLES = {
  photo: "Drop photographs here",
  scan: "Drop a scan here",
  frames: "Drop further frames of the scan here",
};

/** @param {{state: string}} file */
const isLeft = ({ state }) => state !== "opened" && state !== "kept";

/**
 * @typedef {{opened: {file: string, kind: string}[], refused: {name: string, error: string, file: string}[], waiting: string[]}}
 *   Opened the reply to `open_files`
 * @typedef {import("../../protocol.d.ts").ServedFile} Served
 * @typedef {{scan?: "replace" | "frames" | "stations" | null}} Landing what becomes of scans
 * @typedef {ReturnType<typeof makeDialog> & {add: (added: Iterable<File>) => void, expect: (what: string | null) => void}}
 *   FilesDialog `expect`: says which type of file it is opened for
 */

/** @type {FilesDialog | null} */
let files = null;

/** One file of a drop: due, being sent, sent, opened or refused. */
class FileEntry {
  /**
   * @param {File} file
   * @param {{removed: (entry: FileEntry) => void, isSeen: () => boolean}} list `isSeen`: whether its rows are in sight
   */
  constructor(file, { removed, isSeen }) {
    this.file = file;
    this.isSeen = isSeen;
    this.state = "due";
    this.id = ""; // until it is uploaded
    this.abort = () => {};
    this.progress = element("progress", { max: 1, value: 0, hidden: true, "aria-label": `Upload of ${file.name}` });
    this.status = element("span", { class: "file-status", role: "status" });
    this.discard = button({
      label: `Remove ${file.name}`,
      icon: "close",
      bare: true,
      kind: "plain small",
      act: () => (this.state === "sending" ? this.abort() : removed(this)),
    });
    this.row = element(
      "li",
      { class: "file-row" },
      icon("file"),
      element("span", { class: "clip", title: file.name }, file.name),
      element("span", { class: "dim figures" }, bytes(file.size)),
      this.discard,
      this.progress,
      this.status,
    );
    this.setStatus("Waiting …");
  }

  setStatus(/** @type {string} */ text, level = "") {
    setText(this.status, text);
    this.row.dataset.level = level;
  }

  refuse(/** @type {unknown} */ error) {
    this.state = "refused";
    const cancelled = wasCancelled(error);
    this.setStatus(messageOf(error), cancelled ? "warn" : "bad");
    if (!cancelled && !this.isSeen()) notice(messageOf(error), "bad");
  }

  /** Upload the file; what it becomes is decided when all are there. */
  async send() {
    this.state = "sending";
    this.progress.hidden = false;
    this.setStatus("Uploading …");
    const sending = sendFile(this.file, {
      what: "any",
      progress: (share) => {
        this.progress.value = share;
        this.setStatus(share < 1 ? `${Math.round(100 * share)} %` : "Uploaded; reading …");
      },
    });
    this.abort = sending.abort;
    try {
      this.id = await sending.finished;
      this.state = "sent";
      this.setStatus("Uploaded.");
    } catch (error) {
      this.refuse(error);
    }
    this.progress.hidden = true;
  }

  /** Show what became of the file. @param {Opened} answer */
  settle({ opened, refused, waiting }) {
    const error = refused.find(({ file }) => file === this.id)?.error;
    const made = opened.find(({ file }) => file === this.id);
    if (error && !waiting.includes(this.id)) this.refuse(new Error(error));
    else if (made) {
      this.state = "opened";
      this.setStatus(`Opened as ${labelOf(made.kind)}.`, "ok");
    } else this.state = waiting.includes(this.id) ? "kept" : "opened"; // as part of another file
  }
}

/**
 * The files of the served folder; scans can be ticked and opened together.
 * @param {(paths: string[]) => Promise<boolean>} openScans
 * @param {() => void} close closes the dialog
 */
const servedList = (openScans, close) => {
  const list = element("ul", { class: "served-list" });
  const title = element("h3", {});
  const ticked = new Set();
  const together = button({ label: "Open together", kind: "small edits", act: () => openScans([...ticked]).then(show) });
  const again = button({ label: "Refresh", kind: "small", act: () => request("list_served") });
  const section = element(
    "section",
    { class: "served" },
    element("div", { class: "row" }, title, element("span", { class: "row" }, together, again)),
    list,
  );
  const tick = (/** @type {string} */ path) => {
    const box = element("input", {
      type: "checkbox",
      checked: ticked.has(path),
      "aria-label": `Choose ${path}`,
      on: {
        change: () => {
          box.checked ? ticked.add(path) : ticked.delete(path);
          showTogether();
        },
      },
    });
    return box;
  };
  const showTogether = () => {
    together.hidden = ticked.size < 2;
    setText(partOf(together, "span"), `Open ${ticked.size} scans together`);
  };
  const row = (/** @type {boolean} */ several) => (/** @type {Served} */ { path, size, kind }) => {
    const open = async () => {
      opener.disabled = true;
      const opened = kind === "scan"
        ? await openScans([path])
        : await request("open_served", { path, what: kind, photo: NEEDS_PHOTO.has(kind) ? store.shown() : undefined });
      opener.disabled = false;
      if (opened) setText(partOf(opener, "span"), "Open again");
      if (opened && store.get("scan") && store.photo()) close();
    };
    const usable = OPENABLE.has(kind);
    const opener = button({
      label: usable ? `Open as ${labelOf(kind)}` : "Cannot be opened",
      kind: "small",
      disabled: !usable,
      act: open,
    });
    return element(
      "li",
      { class: "file-row" },
      several && kind === "scan" ? tick(path) : icon("file"),
      element("span", { class: "clip", title: path }, path),
      element("span", { class: "dim figures" }, bytes(size)),
      opener,
    );
  };
  const show = () => {
    const served = store.get("served");
    section.hidden = !served;
    if (!served) return;
    /** @type {Served[]} */
    const found = served.files;
    setText(title, `Served folder ${served.label ?? ""}`);
    const scans = found.filter(({ kind }) => kind === "scan").map(({ path }) => path);
    for (const path of ticked) if (!scans.includes(path)) ticked.delete(path);
    const nothing = element("li", { class: "dim" }, "It contains no file that can be opened.");
    setChildren(list, ...(found.length ? found.map(row(scans.length > 1)) : [nothing]));
    showTogether();
  };
  const untick = () => {
    ticked.clear();
    show();
  };
  store.watch(["served", "shown"], show);
  show();
  return { section, untick };
};

const build = () => {
  /** @type {FileEntry[]} */
  const waiting = [];
  /** @type {string | null} type of file that the dialog was opened for */
  let expected = null;
  const list = element("ul", { class: "file-list", "aria-label": "Files to open" });
  const input = element(
    "input",
    { type: "file", multiple: true, class: "visually-hidden", tabIndex: -1, "aria-hidden": "true" },
  );
  const hint = element("p", { class: "dim", id: newId("hint") });
  const choose = button({
    label: "Choose files…",
    kind: "primary",
    autofocus: true,
    act: () => input.click(),
    "aria-describedby": hint.id,
  });
  const zone = element(
    "div",
    { class: "drop-zone" },
    icon("download"),
    element("p", { class: "drop-title" }, "Drop a scan and its photographs here"),
    hint,
    choose,
    input,
  );
  const confirm = confirmation("Begin another project?", "Begin it all the same");
  const { question, ask } = scanQuestion();

  /** Begin a project with files; the page follows it, unless that has to be confirmed. */
  const beginProject = async (/** @type {string[]} */ ids, fields = {}) => {
    const answer = await request("new_project", { files: ids, ...fields });
    if (answer?.asks) confirm.ask(answer.asks, () => beginProject(ids, { sure: true }));
  };

  /** What becomes of scans without being asked: the dialog was opened for that. */
  const intended = () => /** @type {Landing} */ (expected === "frames" && store.get("scan") ? { scan: "frames" } : {});

  /** Open uploaded files; those that lack something stay in the list of waiting ones. */
  const openTogether = async (/** @type {string[]} */ ids, choice = {}) => {
    for (const one of waiting) if (ids.includes(one.id)) one.setStatus("Reading …");
    const answer = await request("open_files", { files: ids, ...choice });
    if (!answer) {
      for (const one of waiting) if (ids.includes(one.id)) one.setStatus("Uploaded.");
      return;
    }
    if (answer.asks) {
      for (const one of waiting) if (answer.waiting.includes(one.id)) one.state = "kept";
      ask(answer, (chosen) => {
        if (chosen === "new") return beginProject(answer.waiting);
        return chosen && openTogether(answer.waiting, { ...choice, scan: chosen });
      });
    } else {
      for (const one of waiting) if (ids.includes(one.id) && one.state !== "opened") one.settle(answer);
      for (const { name, error, file } of answer.refused) {
        if (!waiting.some(({ id }) => id === file)) notice(error.startsWith(name) ? error : `${name}: ${error}`, "bad");
      }
    }
    changed();
    if (waiting.some(isLeft) || answer.waiting.length || answer.refused.length) {
      if (answer.waiting.length) made.open();
      return;
    }
    waiting.length = 0;
    changed();
    /** @type {Opened} */
    const { opened } = answer;
    const offers = opened.some(({ kind }) => kind === "scan") && offeredPictures().length > 0;
    if (opened.length && !offers) made.close();
  };

  /**
   * Open scans of the served folder.
   * @param {string[]} paths
   * @param {Landing} [choice]
   * @returns {Promise<boolean>} whether they were opened
   */
  const openServed = async (paths, choice = intended()) => {
    const answer = await request("open_served", { paths, what: "scan", ...choice });
    if (!answer?.asks) {
      if (answer) served.untick();
      return Boolean(answer);
    }
    return new Promise((done) => {
      ask(answer, (chosen) => {
        const opened = chosen && chosen !== "new" ? openServed(paths, { scan: chosen }) : false;
        done(opened);
        return opened;
      }, false);
    });
  };
  const addFrames = () => {
    expect("frames");
    input.click();
  };
  const served = servedList(openServed, () => made.close());

  const made = makeDialog(
    "Open files",
    { kind: "files-dialog" },
    zone,
    question,
    confirm.box,
    list,
    waitingList(openTogether),
    scanClouds(addFrames),
    embeddedList(),
    served.section,
  );
  const changed = () => setChildren(list, ...waiting.filter(({ state }) => state !== "kept").map(({ row }) => row));
  const removed = (/** @type {FileEntry} */ one) => {
    waiting.splice(waiting.indexOf(one), 1);
    changed();
  };
  let sending = false;
  /** Send the due files in sequence, including those added meanwhile, and open them when all are there. */
  const sendAll = async () => {
    changed();
    if (sending) return;
    sending = true;
    for (let next; (next = waiting.find(({ state }) => state === "due")); ) await next.send();
    sending = false;
    const ids = waiting.filter(({ state }) => state === "sent").map(({ id }) => id);
    if (ids.length) await openTogether(ids, intended());
  };
  const add = (/** @type {Iterable<File>} */ added) => {
    for (const old of waiting.filter((one) => !isLeft(one))) removed(old);
    waiting.push(...[...added].map((file) => new FileEntry(file, { removed, isSeen: () => made.dialog.open })));
    sendAll();
  };
  const expect = (/** @type {string | null} */ what) => {
    expected = what;
    const limit = store.get("limits")?.upload_bytes;
    const most = limit ? ` Up to ${bytes(limit)} each.` : "";
    setText(partOf(zone, ".drop-title"), TITLES[what ?? ""] ?? "Drop a scan and its photographs here");
    setText(hint, `${what === "frames" ? `Frames: ${ABOUT_FRAMES}` : readable()}${most}`);
    input.accept = accepted();
  };
  input.addEventListener("change", () => {
    add(input.files ?? []);
    input.value = "";
  });
  return { ...made, add, expect };
};

/**
 * Open the dialog.
 * @param {"scan" | "photo" | "frames" | null} [what] type of file to ask for; frames: further clouds of the open scan
 */
export const openFiles = (what = null) => {
  if (store.readOnly) return;
  files ??= build();
  files.expect(what);
  if (store.get("served")) request("list_served");
  files.open();
};

/** Open files that were dropped on the page. @param {Iterable<File>} dropped */
export const addFiles = (dropped) => {
  if (store.readOnly) {
    notice("This page is read-only: files can only be opened with the link that permits editing.", "warn");
    return;
  }
  files ??= build();
  if (!files.dialog.open) openFiles();
  files.add(dropped);
};
