/** Export to other programs: targets with what each is for, of all registered photographs or of the shown one. */

import { ask } from "../net/connection.js";
import { request } from "../net/requests.js";
import { store } from "../net/store.js";
import { isRunning, shareDone } from "../state/pipeline.js";
import { view } from "../state/view.js";
import { button, fill } from "../ui/controls.js";
import { element, newId, setAttribute, setChildren, setText } from "../ui/dom.js";
import { icon } from "../ui/icons.js";
import { notice } from "../ui/notices.js";
import { throttled } from "../ui/throttle.js";

const KIND = "hand_over";
const ZIP = "export/hand-over.zip";
const TARGETS_KEY = "ladarreg-targets";
const FOLDER_KEY = "ladarreg-programs-folder";
/** Interval between two requests of the table, ms. */
const EVERY_MS = 400;

const stored = (key) => {
  try {
    return localStorage.getItem(key) ?? "";
  } catch {
    return "";
  }
};

const keep = (key, text) => {
  try {
    localStorage.setItem(key, text);
  } catch {
    // storage is disabled: it has to be chosen again next time
  }
};

/** A target with its tick box, its sentence, and why it cannot be written. */
const targetRow = ({ name, title, purpose }, ticked, changed) => {
  const [purposeId, refusalId] = [newId("purpose"), newId("refusal")];
  const box = element("input", {
    type: "checkbox",
    checked: ticked,
    "aria-describedby": `${purposeId} ${refusalId}`,
    on: { change: changed },
  });
  const refusal = element("span", { id: refusalId, class: "refusal", hidden: true });
  const item = element(
    "li",
    {},
    element("label", { class: "target-name" }, box, title),
    element("span", { id: purposeId, class: "dim" }, purpose),
    refusal,
  );
  const show = (why) => {
    refusal.hidden = !why;
    setChildren(refusal, ...(why ? [icon("warn"), element("span", {}, `Cannot be written: ${why}`)] : []));
    item.classList.toggle("left-out", Boolean(why));
    box.disabled = Boolean(why);
  };
  return { name, item, box, show, refused: () => box.disabled };
};

/** @returns {HTMLElement} the panel */
export const mountHandOver = () => {
  let rows = [];
  let table = null;
  let failed = "";
  let started = null; // id of the job that this page has started
  let savesZip = false; // this page has asked for the zip, and saves it as soon as it is ready
  const ticked = new Set(stored(TARGETS_KEY).split(",").filter(Boolean));

  const list = element("ul", { class: "target-list" });
  const scope = element("select", { class: "select small", "aria-label": "Photographs to export" });
  const frame = element("select", { class: "select small", "aria-label": "Frame of coordinates" });
  const frameRow = element("label", { class: "inline", hidden: true }, "in the frame of the", frame);
  const full = element("input", { type: "checkbox" });
  const crop = element("input", { type: "checkbox" });
  const last = element("input", { type: "checkbox" });
  const lastRow = element("label", { class: "inline", hidden: true }, last, "poses that are out of date, as last solved");
  const goes = element("p", { class: "dim", role: "status" });
  const wrong = element("p", { class: "form-wrong", role: "alert", hidden: true });
  const zip = button({ label: "Export as zip", kind: "primary small", icon: "download", act: () => run(null) });
  const ready = element("a", { class: "ready", hidden: true, download: "", href: ZIP }, "Save the finished export");
  const id = newId("field");
  const folder = element("input", {
    id,
    class: "folder",
    placeholder: "/home/me/handover/office-7",
    spellcheck: false,
    autocomplete: "off",
    value: stored(FOLDER_KEY),
  });
  const force = element("input", { type: "checkbox" });
  const write = element("button", { type: "submit", class: "button" }, icon("folder"), element("span", {}, "Export into folder"));
  const form = element(
    "form",
    { class: "export-form edits" },
    element("label", { for: id }, "Folder for the programs' files, on the workbench's computer"),
    folder,
    element("div", { class: "row" }, write, element("label", { class: "inline" }, force, "replace an earlier export")),
  );
  const bar = element("progress", { max: 1, "aria-label": "Progress of the export" });
  const said = element("span", { class: "clip" });
  const cancel = button({
    label: "Cancel the export",
    text: "Cancel",
    icon: "stop",
    kind: "small edits",
    act: () => request("job_control", { action: "stop" }),
  });
  const running = element("div", { class: "hand-over-running", hidden: true }, bar, said, cancel);
  const options = element(
    "fieldset",
    { class: "hand-over-options edits" },
    element("legend", { class: "visually-hidden" }, "Options of the export"),
    frameRow,
    element("label", { class: "inline", title: "Instead of meshes reduced by error: larger files" }, full, "whole meshes"),
    element(
      "label",
      { class: "inline", title: "Models without what no photograph covers" },
      crop,
      "models only where photographs cover them",
    ),
    lastRow,
  );
  const part = element(
    "section",
    { class: "dock-part hand-over-part", "aria-label": "For other programs" },
    element(
      "div",
      { class: "part-head" },
      element("h2", {}, "Other programs"),
      element("div", { class: "end" }, element("span", { class: "edits" }, scope), zip),
    ),
    element(
      "div",
      { class: "part-body" },
      running,
      wrong,
      ready,
      goes,
      element("fieldset", { class: "edits" }, element("legend", { class: "visually-hidden" }, "Targets"), list),
      options,
      form,
    ),
  );

  const wanted = () => ({
    ...(scope.value === "shown" ? { photos: [store.shown()].filter(Boolean) } : {}),
    frame: frame.value || "scanner",
    full: full.checked,
    crop: crop.checked ? "photo" : "none",
    last_solved: last.checked,
  });
  const chosen = () => rows.filter(({ box, refused }) => box.checked && !refused()).map(({ name }) => name);

  const complain = (text) => {
    wrong.hidden = !text;
    setText(wrong, text);
  };

  const run = async (into) => {
    complain("");
    ready.hidden = true;
    if (store.readOnly) {
      await saveLatest();
      return;
    }
    const targets = chosen();
    if (!targets.length) {
      complain("Tick the programs to export to.");
      return;
    }
    const asked = { targets, ...wanted(), ...(into ? { folder: into, force: force.checked } : {}) };
    savesZip = !into;
    try {
      started = (await ask(KIND, asked)).job;
    } catch (error) {
      savesZip = false;
      complain(error.message);
      return;
    }
    if (into) notice(`Exporting into ${into}.`);
  };

  /** A page that may only look saves what others have exported. */
  const saveLatest = async () => {
    const { ok } = await fetch(ZIP, { method: "HEAD", cache: "no-store" }).catch(() => ({ ok: false }));
    if (ok) ready.click();
    else notice("Nothing has been exported for other programs yet: ask someone who is allowed to edit to export it.", "warn");
  };

  form.addEventListener("submit", (event) => {
    event.preventDefault();
    const name = folder.value.trim();
    if (!name) {
      complain("Enter the folder for the export.");
      return;
    }
    keep(FOLDER_KEY, name);
    run(name);
  });
  store.onEvent("hand_over_ready", ({ url }) => {
    ready.href = url;
    ready.hidden = false;
    if (savesZip) ready.click();
    savesZip = false;
  });

  const isOpen = () => view.get().step === "export" && !store.readOnly;
  const refresh = throttled(async () => {
    if (!isOpen() || !store.get("scan")) return;
    try {
      table = await ask("export_targets", wanted());
      failed = "";
    } catch (error) {
      table = null;
      failed = error.message;
    }
    show();
  }, EVERY_MS);

  const changed = () => {
    for (const { name, box } of rows) box.checked ? ticked.add(name) : ticked.delete(name);
    keep(TARGETS_KEY, [...ticked].join(","));
    show();
  };

  const showRows = () => {
    if (table && rows.map(({ name }) => name).join() !== table.targets.map(({ name }) => name).join()) {
      rows = table.targets.map((target) => targetRow(target, ticked.has(target.name), changed));
      setChildren(list, ...rows.map(({ item }) => item));
    }
    for (const [k, row] of rows.entries()) row.show(table ? table.targets[k]?.refusal : failed);
  };

  const sentence = () => {
    if (store.readOnly) return "A page that may only look saves what was exported last.";
    if (failed) return failed;
    if (!table) return store.get("scan") ? "" : "Open a scan and register photographs first.";
    const [go, out] = [table.photos, table.left_out];
    const names = go.length > 3 ? `${go.length} photographs` : go.map(({ name }) => name).join(", ");
    const left = out.map(({ name, why }) => `${name}: ${why}`).join("; ");
    return [go.length ? `Goes out: ${names}.` : "", out.length ? `Left out: ${left}.` : ""].filter(Boolean).join(" ");
  };

  const show = () => {
    const job = store.get("job");
    const busy = isRunning(job);
    const own = busy && job.kind === KIND;
    const world = store.get("scan")?.world;
    fill(scope, [["all", "all photographs"], ["shown", "this photograph"]], scope.value || "all");
    fill(frame, [["scanner", "scanner"], ["world", "world"]], world ? frame.value || "scanner" : "scanner");
    frameRow.hidden = !world;
    if (table?.left_out.some(({ is_stale }) => is_stale)) lastRow.hidden = false;
    else if (!last.checked) lastRow.hidden = true;
    showRows();
    setText(goes, sentence());
    if (job && job.id === started && !busy) {
      started = null;
      if (job.state !== "done") savesZip = false;
      if (job.state === "failed") complain(job.said);
    }
    running.hidden = !own;
    if (own) {
      const share = shareDone(job);
      if (share === null) bar.removeAttribute("value");
      else bar.value = share;
      setText(said, job.said || job.label);
    }
    const nothing = !store.readOnly && !chosen().length;
    zip.disabled = write.disabled = busy || nothing;
    zip.title = write.title = busy ? "A job is running" : nothing ? "Tick at least one program" : "";
    setAttribute(list, "aria-busy", isOpen() && !table && !failed && Boolean(store.get("scan")));
  };

  for (const field of [scope, frame, full, crop, last]) field.addEventListener("change", () => refresh());
  view.on((_, names) => names.has("step") && refresh());
  store.watch(["poses:*", "picks:*", "photos", "scan", "shown"], () => refresh());
  store.watch(["job", "scan", "shown"], show);
  show();
  refresh();
  return part;
};
