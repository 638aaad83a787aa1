/** The dialog for opening files: dropped, chosen, or from the served folder. */

import { request } from "../net/requests.js";
import { store } from "../net/store.js";
import { sendFile } from "../net/uploads.js";
import { button } from "../ui/controls.js";
import { makeDialog } from "../ui/dialog.js";
import { element, newId, setChildren, setText } from "../ui/dom.js";
import { icon } from "../ui/icons.js";
import { notice } from "../ui/notices.js";
import { bytes } from "../ui/numbers.js";
import { ACCEPTED, inOrder, kindOf, KINDS } from "./file_kinds.js";

const OPENABLE = new Set(["scan", "photo", "camera", "matches"]);
const LABELS = {
  scan: "scan",
  photo: "photograph",
  camera: "camera",
  matches: "matches",
  project: "project",
  other: "file",
};
const NEEDS_PHOTO = new Set(["camera", "matches"]);
const UNKNOWN = "Unknown type: choose one.";

const isLeft = ({ state }) => state === "waiting" || state === "refused";

let files = null; // the dialog

/** One file of the list: waiting, due, being sent, opened or refused. */
class FileEntry {
  constructor(file, changed, removed) {
    const { kind, sure } = kindOf(file.name);
    Object.assign(this, { file, kind, sure, state: "waiting", abort: () => {} });
    this.choice = element(
      "select",
      {
        "aria-label": `Type of ${file.name}`,
        on: { change: () => (this.#chosen(), changed()) },
      },
      sure ? null : element("option", { value: "", selected: true, disabled: true }, "Choose a type"),
      ...KINDS.map((each) => element("option", { value: each.kind, selected: sure && each.kind === kind }, each.label)),
    );
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
      this.choice,
      this.progress,
      this.discard,
      this.status,
    );
    if (!sure) this.setStatus(UNKNOWN, "warn");
  }

  #chosen() {
    this.kind = this.choice.value;
    this.sure = true;
    if (this.status.textContent === UNKNOWN) this.setStatus("");
  }

  setStatus(text, level = "") {
    setText(this.status, text);
    this.row.dataset.level = level;
  }

  wait() {
    this.state = "due";
    this.setStatus("Waiting …");
  }

  async send() {
    this.state = "sending";
    this.choice.disabled = true;
    this.progress.hidden = false;
    const photo = NEEDS_PHOTO.has(this.kind) ? store.shown() : null;
    this.setStatus("Uploading …");
    const sending = sendFile(this.file, {
      what: this.kind,
      photo,
      progress: (share) => {
        this.progress.value = share;
        this.setStatus(share < 1 ? `${Math.round(100 * share)} %` : "Uploaded; reading …");
      },
    });
    this.abort = sending.abort;
    try {
      await sending.finished;
      this.state = "opened";
      this.setStatus("Opened.", "ok");
    } catch (error) {
      this.state = "refused";
      this.choice.disabled = false;
      this.setStatus(error.message, error.name === "AbortError" ? "warn" : "bad");
      if (!files.dialog.open && error.name !== "AbortError") notice(error.message, "bad");
    }
    this.progress.hidden = true;
  }
}

const servedList = () => {
  const list = element("ul", { class: "served-list" });
  const title = element("h3", {});
  const again = button({ label: "Refresh", kind: "small", act: () => request("list_served") });
  const section = element("section", { class: "served" }, element("div", { class: "row" }, title, again), list);
  const row = ({ path, size, kind }) => {
    const open = async () => {
      opener.disabled = true;
      const opened = await request(
        "open_served",
        { path, what: OPENABLE.has(kind) ? kind : "scan", photo: NEEDS_PHOTO.has(kind) ? store.shown() : undefined },
      );
      opener.disabled = false;
      if (opened) setText(opener.querySelector("span"), "Open again");
      if (opened && store.get("scan") && store.photo()) files.close();
    };
    const usable = OPENABLE.has(kind);
    const opener = button({
      label: usable ? `Open as ${LABELS[kind]}` : "Cannot be opened",
      kind: "small",
      disabled: !usable,
      act: open,
    });
    return element(
      "li",
      { class: "file-row" },
      icon("file"),
      element("span", { class: "clip", title: path }, path),
      element("span", { class: "dim figures" }, bytes(size)),
      opener,
    );
  };
  const show = () => {
    const served = store.get("served");
    section.hidden = !served;
    if (!served) return;
    setText(title, `Served folder ${served.label ?? ""}`);
    const nothing = element("li", { class: "dim" }, "It contains no file that can be opened.");
    setChildren(list, ...(served.files.length ? served.files.map(row) : [nothing]));
  };
  store.watch(["served", "shown"], show);
  show();
  return section;
};

const build = () => {
  const waiting = [];
  const list = element("ul", { class: "file-list", "aria-label": "Files to open" });
  const input = element(
    "input",
    { type: "file", multiple: true, accept: ACCEPTED, class: "visually-hidden", tabIndex: -1, "aria-hidden": "true" },
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
  const send = button({ label: "Open", kind: "primary", act: () => sendAll(waiting.filter(isLeft)) });
  const foot = element("div", { class: "form-foot", hidden: true }, send);
  const sample = element(
    "p",
    { class: "dim" },
    "No data yet? ",
    element("code", {}, "ladarreg demo"),
    " opens a sample project; ",
    element("code", {}, "ladarreg simulate"),
    " generates more.",
  );
  files = makeDialog("Open files", { kind: "files-dialog" }, zone, list, foot, servedList(), sample);

  const changed = () => {
    const left = waiting.filter(isLeft);
    setChildren(list, ...waiting.map(({ row }) => row));
    foot.hidden = left.length === 0;
    send.disabled = left.some(({ sure }) => !sure);
    setText(send.querySelector("span"), left.length > 1 ? `Open ${left.length} files` : "Open");
    send.title = send.disabled ? "Choose the type of each file first" : "";
  };
  const removed = (one) => {
    waiting.splice(waiting.indexOf(one), 1);
    changed();
  };
  let sending = false;
  /** Send the due files in sequence, including those added meanwhile. */
  const sendAll = async (due) => {
    for (const one of due) one.wait();
    changed();
    if (sending) return;
    sending = true;
    for (let next; (next = inOrder(waiting.filter(({ state }) => state === "due"))[0]); ) {
      const sent = next.send();
      changed();
      await sent;
      changed();
    }
    sending = false;
    if (waiting.some(({ state }) => state !== "opened")) return;
    waiting.length = 0;
    changed();
    files.close();
  };
  files.add = (added) => {
    for (const old of waiting.filter(({ state }) => state === "opened")) removed(old);
    const entries = [...added].map((file) => new FileEntry(file, changed, removed));
    waiting.push(...entries);
    changed();
    if (entries.length && entries.every(({ sure }) => sure)) sendAll(entries);
  };
  files.expect = (what) => {
    const limit = store.get("limits")?.upload_bytes;
    const most = limit ? ` Up to ${bytes(limit)} each.` : "";
    setText(
      zone.querySelector(".drop-title"),
      what === "photo"
        ? "Drop photographs here"
        : what === "scan"
        ? "Drop a scan here"
        : "Drop a scan and its photographs here",
    );
    setText(
      hint,
      `Scans: E57, NPZ, PCD, descriptor JSON. Photographs: PNG, JPEG, TIFF. Also camera files and matches.${most}`,
    );
  };
  input.addEventListener("change", () => {
    files.add(input.files);
    input.value = "";
  });
  return files;
};

/**
 * Open the dialog.
 * @param {"scan" | "photo" | null} [what] type of file to ask for
 */
export const openFiles = (what = null) => {
  files ??= build();
  files.expect(what);
  if (store.get("served")) request("list_served");
  files.open();
};

/** Open files that were dropped on the page. @param {Iterable<File>} dropped */
export const addFiles = (dropped) => {
  openFiles();
  files.add(dropped);
};
