/** Opening files: dropped, chosen or from the served folder. */

import { button, element, newId, put, say } from "../ui/dom.js";
import { makeDialog } from "../ui/dialog.js";
import { wish } from "../net/requests.js";
import { ACCEPTED, inOrder, kindOf, KINDS } from "./file_kinds.js";
import { icon } from "../ui/icons.js";
import { notice } from "../ui/notices.js";
import { bytes } from "../ui/numbers.js";
import { store } from "../net/store.js";
import { sendFile } from "../net/uploads.js";

const OPENED = new Set(["scan", "photo", "camera", "matches"]);
const WORDS = {
  scan: "scan",
  photo: "photograph",
  camera: "camera",
  matches: "matches",
  project: "project",
  other: "file",
};
const NEEDS_PHOTO = new Set(["camera", "matches"]);
const UNTOLD = "The name does not tell what it is: say it here.";

const isLeft = ({ state }) => state === "waiting" || state === "refused";

let made = null;

/** One file that waits to be told about, is due, travels, has arrived or was refused. */
class Waiting {
  constructor(file, changed, gone) {
    const { kind, sure } = kindOf(file.name);
    Object.assign(this, { file, kind, sure, state: "waiting", abort: () => {} });
    this.choice = element(
      "select",
      {
        "aria-label": `What ${file.name} is`,
        on: { change: () => (this.#told(), changed()) },
      },
      sure ? null : element("option", { value: "", selected: true, disabled: true }, "What is it?"),
      ...KINDS.map((each) => element("option", { value: each.kind, selected: sure && each.kind === kind }, each.label)),
    );
    this.progress = element("progress", { max: 1, value: 0, hidden: true, "aria-label": `Sending ${file.name}` });
    this.said = element("span", { class: "file-said", role: "status" });
    this.away = button({
      label: `Leave ${file.name} out`,
      icon: "close",
      bare: true,
      kind: "plain small",
      act: () => (this.state === "sending" ? this.abort() : gone(this)),
    });
    this.row = element(
      "li",
      { class: "file-row" },
      icon("file"),
      element("span", { class: "clip", title: file.name }, file.name),
      element("span", { class: "dim figures" }, bytes(file.size)),
      this.choice,
      this.progress,
      this.away,
      this.said,
    );
    if (!sure) this.tell(UNTOLD, "warn");
  }

  #told() {
    this.kind = this.choice.value;
    this.sure = true;
    if (this.said.textContent === UNTOLD) this.tell("");
  }

  tell(text, level = "") {
    say(this.said, text);
    this.row.dataset.level = level;
  }

  wait() {
    this.state = "due";
    this.tell("Waits its turn …");
  }

  async send() {
    this.state = "sending";
    this.choice.disabled = true;
    this.progress.hidden = false;
    const photo = NEEDS_PHOTO.has(this.kind) ? store.shown() : null;
    this.tell("Sending …");
    const sending = sendFile(this.file, {
      what: this.kind,
      photo,
      progress: (share) => {
        this.progress.value = share;
        this.tell(share < 1 ? `${Math.round(100 * share)} %` : "Arrived; being read …");
      },
    });
    this.abort = sending.abort;
    try {
      await sending.finished;
      this.state = "opened";
      this.tell("Opened.", "ok");
    } catch (error) {
      this.state = "refused";
      this.choice.disabled = false;
      this.tell(error.message, error.name === "AbortError" ? "warn" : "bad");
      if (!made.dialog.open && error.name !== "AbortError") notice(error.message, "bad");
    }
    this.progress.hidden = true;
  }
}

const servedList = () => {
  const list = element("ul", { class: "served-list" });
  const title = element("h3", {});
  const again = button({ label: "Look again", kind: "small", act: () => wish("list_served") });
  const section = element("section", { class: "served" }, element("div", { class: "row" }, title, again), list);
  const row = ({ path, size, kind }) => {
    const open = async () => {
      opener.disabled = true;
      const opened = await wish(
        "open_served",
        { path, what: OPENED.has(kind) ? kind : "scan", photo: NEEDS_PHOTO.has(kind) ? store.shown() : undefined },
      );
      opener.disabled = false;
      if (opened) say(opener.querySelector("span"), "Opened; again");
      if (opened && store.get("scan") && store.photo()) made.close();
    };
    const usable = OPENED.has(kind);
    const opener = button({
      label: usable ? `Open as ${WORDS[kind]}` : "Cannot be opened",
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
    say(title, `In the served folder ${served.label ?? ""}`);
    const nothing = element("li", { class: "dim" }, "There is no file in it that could be opened.");
    put(list, ...(served.files.length ? served.files.map(row) : [nothing]));
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
    { type: "file", multiple: true, accept: ACCEPTED, class: "told", tabIndex: -1, "aria-hidden": "true" },
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
    "Nothing at hand? ",
    element("code", {}, "ladarreg demo"),
    " opens a sample; ",
    element("code", {}, "ladarreg simulate"),
    " makes more.",
  );
  made = makeDialog("Open files", { kind: "files-dialog" }, zone, list, foot, servedList(), sample);

  const changed = () => {
    const left = waiting.filter(isLeft);
    put(list, ...waiting.map(({ row }) => row));
    foot.hidden = left.length === 0;
    send.disabled = left.some(({ sure }) => !sure);
    say(send.querySelector("span"), left.length > 1 ? `Open ${left.length} files` : "Open");
    send.title = send.disabled ? "Say first what each file is" : "";
  };
  const gone = (one) => {
    waiting.splice(waiting.indexOf(one), 1);
    changed();
  };
  let going = false;
  /** Send one after the other what is due, also what becomes due meanwhile. */
  const sendAll = async (due) => {
    for (const one of due) one.wait();
    changed();
    if (going) return;
    going = true;
    for (let next; (next = inOrder(waiting.filter(({ state }) => state === "due"))[0]); ) {
      const sending = next.send();
      changed();
      await sending;
      changed();
    }
    going = false;
    if (waiting.some(({ state }) => state !== "opened")) return;
    waiting.length = 0;
    changed();
    made.close();
  };
  made.take = (files) => {
    for (const old of waiting.filter(({ state }) => state === "opened")) gone(old);
    const came = [...files].map((file) => new Waiting(file, changed, gone));
    waiting.push(...came);
    changed();
    if (came.length && came.every(({ sure }) => sure)) sendAll(came);
  };
  made.want = (what) => {
    const limit = store.get("limits")?.upload_bytes;
    const most = limit ? ` At most ${bytes(limit)} each.` : "";
    say(
      zone.querySelector(".drop-title"),
      what === "photo"
        ? "Drop photographs here"
        : what === "scan"
        ? "Drop a scan here"
        : "Drop a scan and its photographs here",
    );
    say(
      hint,
      `Scans: E57, NPZ, PCD, descriptor JSON. Photographs: PNG, JPEG, TIFF. Camera files and matches, too.${most}`,
    );
  };
  input.addEventListener("change", () => {
    made.take(input.files);
    input.value = "";
  });
  return made;
};

/**
 * Open the dialog.
 * @param {"scan" | "photo" | null} [what] is looked for
 */
export const openFiles = (what = null) => {
  made ??= build();
  made.want(what);
  if (store.get("served")) wish("list_served");
  made.open();
};

/** Open files that were dropped on the page. @param {Iterable<File>} files */
export const takeFiles = (files) => {
  openFiles();
  made.take(files);
};
