/** Export: targets with what each is for, of all photographs or of the shown one, as a zip or into a folder. */

import { ask } from "../../net/connection.js";
import { request, requestForPhoto } from "../../net/requests.js";
import { store } from "../../net/store.js";
import { isRunning, shareDone } from "../../state/pipeline.js";
import { progressNow } from "../../state/progress.js";
import { view } from "../../state/view.js";
import { button, fill } from "../../ui/controls.js";
import { element, newId, setAttribute, setChildren, setText } from "../../ui/dom.js";
import { fieldOf, messageOf } from "../../ui/faults.js";
import { icon } from "../../ui/icons.js";
import { notice } from "../../ui/notices.js";
import { throttled } from "../../ui/throttle.js";

const RESULTS = "results";
const ALL = "all";
const MATCHES = "matches.json";
/**
 * @typedef {import("../../state/progress.js").Target} Target
 * @typedef {{targets: Target[], photos: {id: string, name: string}[], left_out: {name: string, why: string, is_stale: boolean}[]}} Table
 *   the answer to `export_targets`
 * @typedef {[string, string, boolean]} ResultFile name, contents, and whether only an accepted pose is written so
 */

/** @type {ResultFile[]} */
const FILES = [
  ["registration.json", "pose, covariance, matches, options", false],
  ["report.html", "verdict, pictures, residuals and maps, to read and to print", false],
  [MATCHES, "the matches, which can be opened again", false],
  ["registered.png", "the photograph resampled to the scan grid", true],
  ["labels.png", "visibility class of each cell, as codes", true],
  ["visibility.png", "the same in colours, with their legend", true],
  ["uncertainty.png", "registration uncertainty of each cell, in pixels", true],
  ["model.glb", "textured surface", true],
  ["cloud.ply", "coloured points", true],
];
/** @type {ResultFile} */
const OFFSET = ["offset.json", "what was subtracted from the coordinates of the world", true];
const TARGETS_KEY = "ladarreg-targets";
const FOLDER_KEY = "ladarreg-folder";
/** Interval between two requests of the table, ms. */
const EVERY_MS = 400;

/** @param {string} key @param {string} otherwise */
const stored = (key, otherwise) => {
  try {
    return localStorage.getItem(key) ?? otherwise;
  } catch {
    return otherwise;
  }
};

/** @param {string} key @param {string} text */
const keep = (key, text) => {
  try {
    localStorage.setItem(key, text);
  } catch {
    // storage is disabled: it has to be chosen again next time
  }
};

/**
 * A target with its tick box, its sentence, and why it cannot be written.
 * @param {Target} target
 * @param {boolean} ticked
 * @param {() => void} changed
 */
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
  const show = (/** @type {string | undefined} */ why) => {
    refusal.hidden = !why;
    setChildren(refusal, ...(why ? [icon("warn"), element("span", {}, `Cannot be written: ${why}`)] : []));
    item.classList.toggle("left-out", Boolean(why));
    box.disabled = Boolean(why);
  };
  return { name, item, box, show, refused: () => box.disabled };
};

/**
 * The files of the shown photograph's results; each has a tick once it was written from the present pose. If it is left
 * out, and others are exported, those of each of them.
 * @param {() => string} frameNow
 * @param {() => boolean} isCurrent
 * @param {() => boolean} isOfOthers
 */
const mountFiles = (frameNow, isCurrent, isOfOthers) => {
  const list = element("ul", { class: "export-list" });
  const whose = element("p", { class: "dim", hidden: true }, "Of each photograph that is exported; the one shown is left out.");
  /**
   * @param {ResultFile} file
   * @param {{stage: import("../../net/store.js").Stage | null, frame: string | undefined}} now
   */
  const row = ([name, description, needsAcceptance], { stage, frame }) => {
    const exported = frame !== undefined && (name !== OFFSET[0] || frame === "world");
    const known = Boolean(stage) || (name === MATCHES && store.picksOf().length > 0);
    const written = isOfOthers() || (isCurrent() && known && (Boolean(stage?.accepted) || !needsAcceptance));
    return element(
      "li",
      { class: written ? "" : "left-out" },
      element(
        "span",
        { class: `sign ${written && exported ? "ok" : "dim"}` },
        icon(!written ? "cross" : exported ? "tick" : "file"),
      ),
      element("code", {}, name),
      element("span", { class: "dim" }, written ? description : `${description} (not written)`),
    );
  };
  const show = () => {
    const stage = store.stageOf();
    const frame = stage?.stale ? undefined : progressNow().exported[RESULTS];
    const files = [...FILES, ...(frameNow() === "world" ? [OFFSET] : [])];
    setChildren(list, ...files.map((file) => row(file, { stage, frame })));
    whose.hidden = !isOfOthers();
  };
  const part = element(
    "section",
    { class: "dock-part export-files", "aria-label": "Files of the results" },
    element("div", { class: "part-head" }, element("h2", {}, "Files of the results")),
    element("div", { class: "part-body" }, whose, list),
  );
  return { part, show };
};

/** Jobs are numbered as they are started. @param {string} id */
const numberOf = (id) => Number(id.slice(1));

/** @returns {HTMLElement[]} the panel, and the list of files */
export const mountExport = () => {
  /** @type {ReturnType<typeof targetRow>[]} */
  let rows = [];
  /** @type {Table | null} */
  let table = null;
  let failed = "";
  /** @type {string | null} id of the job that this page has started */
  let started = null;
  let saves = ""; // the URL that this page has asked for, and saves as soon as it is written
  const ticked = new Set(stored(TARGETS_KEY, RESULTS).split(",").filter(Boolean));

  const list = element("ul", { class: "target-list" });
  const scope = element("select", { class: "select small", "aria-label": "Photographs to export" });
  const frame = element("select", { class: "select small", "aria-label": "Frame of coordinates" });
  const frameRow = element(
    "label",
    { class: "inline", title: "Coordinates of points, models and poses", hidden: true },
    "in the frame of the",
    frame,
  );
  const place = element("p", { class: "dim", hidden: true });
  const full = element("input", { type: "checkbox" });
  const crop = element("input", { type: "checkbox" });
  const last = element("input", { type: "checkbox" });
  const lastRow = element(
    "label",
    { class: "inline", title: "The files then state on which matches they rest", hidden: true },
    last,
    "export the last solved state",
  );
  const goes = element("p", { class: "dim", role: "status" });
  const wrong = element("p", { class: "form-wrong", role: "alert", hidden: true });
  const zip = button({ label: "Download zip", kind: "primary small", icon: "download", act: () => run("") });
  const ready = element("a", { class: "ready", hidden: true, download: "" }, "Save the finished zip");
  const report = button({ label: "Write report", icon: "file", act: () => writeReport() });
  const written = element("a", { class: "ready", hidden: true, target: "_blank", rel: "noopener" }, "Open the report");
  const id = newId("field");
  const folder = element("input", {
    id,
    class: "folder",
    placeholder: "/home/me/results/office-7",
    spellcheck: false,
    autocomplete: "off",
    value: stored(FOLDER_KEY, ""),
  });
  const force = element("input", { type: "checkbox" });
  const write = element("button", { type: "submit", class: "button" }, icon("folder"), element("span", {}, "Write to folder"));
  const form = element(
    "form",
    { class: "export-form edits" },
    element("label", { for: id }, "Folder on the workbench's computer"),
    folder,
    element("div", { class: "row" }, write, element("label", { class: "inline" }, force, "replace an earlier export")),
    element(
      "p",
      { class: "dim" },
      "A folder is replaced only if it contains exported files and nothing else. The old ones are kept until the new " +
        "ones are complete.",
    ),
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
  const running = element("div", { class: "export-running", hidden: true }, bar, said, cancel);
  const options = element(
    "fieldset",
    { class: "export-options edits" },
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
    { class: "dock-part export-part", "aria-label": "Export" },
    element(
      "div",
      { class: "part-head" },
      element("h2", {}, "Export"),
      element("div", { class: "end" }, element("span", { class: "edits" }, scope), zip),
    ),
    element(
      "div",
      { class: "part-body" },
      running,
      wrong,
      element("div", { class: "row" }, ready, report, written),
      goes,
      element("fieldset", { class: "edits" }, element("legend", { class: "visually-hidden" }, "Targets"), list),
      options,
      place,
      form,
    ),
  );

  const chosen = () => rows.filter(({ box, refused }) => box.checked && !refused()).map(({ name }) => name);
  const ofShown = () => scope.value === "shown";
  const zipUrl = () => `export/${encodeURIComponent(ofShown() ? store.shown() ?? "" : ALL)}.zip`;
  /** @returns {import("../../protocol.js").Commands["export"]} */
  const wanted = () => ({
    targets: chosen(),
    ...(ofShown() ? { photos: [store.shown()].filter((photo) => photo !== null) } : {}),
    frame: frame.value === "world" ? "world" : "scanner",
    full: full.checked,
    crop: crop.checked ? "photo" : "none",
    last_solved: last.checked,
  });
  const isOfOthers = () => Boolean(table?.photos.length && !table.photos.some((photo) => photo.id === store.shown()));
  const files = mountFiles(() => frame.value, () => !store.stageOf()?.stale || last.checked, isOfOthers);

  const complain = (/** @type {string} */ text, field = "") => {
    wrong.hidden = !text;
    setText(wrong, text);
    setAttribute(folder, "aria-invalid", field === "folder");
    if (field === "folder") folder.focus();
  };

  /** Export into a folder; as a zip if there is none. @param {string} into */
  const run = async (into) => {
    complain("");
    ready.hidden = true;
    if (store.readOnly) {
      await saveLatest();
      return;
    }
    saves = into ? "" : zipUrl();
    try {
      started = (await ask("export", { ...wanted(), ...(into ? { folder: into, force: force.checked } : {}) })).job;
    } catch (error) {
      saves = "";
      complain(messageOf(error), fieldOf(error));
      return;
    }
    if (into) notice(`Writing to ${into}.`);
  };

  /** A page that may only look saves what others have exported. */
  const saveLatest = async () => {
    for (const url of [zipUrl(), `export/${ALL}.zip`]) {
      const { ok } = await fetch(url, { method: "HEAD", cache: "no-store" }).catch(() => ({ ok: false }));
      if (!ok) continue;
      ready.href = url;
      ready.click();
      return;
    }
    notice("Nothing has been exported yet: ask someone who is allowed to edit to export it.", "warn");
  };

  const writeReport = async () => {
    written.hidden = true;
    await requestForPhoto("write_report");
  };

  form.addEventListener("submit", (event) => {
    event.preventDefault();
    const name = folder.value.trim();
    if (!name) {
      complain("Enter the folder for the export.", "folder");
      return;
    }
    keep(FOLDER_KEY, name);
    run(name);
  });
  store.onEvent("export_ready", ({ name, url }) => {
    if (url.endsWith(".html")) {
      if (name !== store.shown()) return;
      written.href = url;
      written.hidden = false;
      return;
    }
    if (url !== zipUrl()) return;
    ready.href = url;
    ready.hidden = false;
    if (saves === url) ready.click();
    saves = "";
  });

  const isOpen = () => view.get().step === "export" && !store.readOnly;
  const refresh = throttled(async () => {
    if (!isOpen() || !store.get("scan")) return;
    try {
      table = await ask("export_targets", { ...wanted(), targets: [...ticked] });
      failed = "";
    } catch (error) {
      table = null;
      failed = messageOf(error);
    }
    show();
  }, EVERY_MS);

  const changed = () => {
    for (const { name, box } of rows) box.checked ? ticked.add(name) : ticked.delete(name);
    keep(TARGETS_KEY, [...ticked].join(","));
    show();
    refresh();
  };

  const showRows = () => {
    const targets = table?.targets;
    if (targets && rows.map(({ name }) => name).join() !== targets.map(({ name }) => name).join()) {
      const known = new Set(targets.map(({ name }) => name));
      for (const name of ticked) if (!known.has(name)) ticked.delete(name);
      rows = targets.map((target) => targetRow(target, ticked.has(target.name), changed));
      setChildren(list, ...rows.map(({ item }) => item));
    }
    for (const [k, row] of rows.entries()) row.show(targets ? targets[k]?.refusal : failed);
  };

  const sentence = () => {
    if (store.readOnly) return "A page that may only look saves what was exported last.";
    if (failed) return failed;
    if (!table) return store.get("scan") ? "Checking what can be exported …" : "Open a scan and register photographs first.";
    const [go, out] = [table.photos, table.left_out];
    const names = go.length > 3 ? `${go.length} photographs` : go.map(({ name }) => name).join(", ");
    const left = out.map(({ name, why }) => `${name}: ${why}`).join("; ");
    return [go.length ? `To be exported: ${names}.` : "", out.length ? `Left out: ${left}.` : ""].filter(Boolean).join(" ");
  };

  const show = () => {
    const job = store.get("job");
    const busy = isRunning(job);
    const own = busy && job?.kind === "export" ? job : null;
    const world = store.get("scan")?.world;
    fill(scope, [["all", "all photographs"], ["shown", "this photograph"]], scope.value || "all");
    fill(frame, [["scanner", "scanner"], ["world", "world"]], world ? frame.value || "scanner" : "scanner");
    frameRow.hidden = place.hidden = !world;
    setText(place, world ? `The scanner stands at ${world.position} in the world; ${world.heading}.` : "");
    if (table?.left_out.some(({ is_stale }) => is_stale)) lastRow.hidden = false;
    else if (!last.checked) lastRow.hidden = true;
    showRows();
    files.show();
    setText(goes, sentence());
    if (job && started && numberOf(job.id) > numberOf(started)) started = null; // it ended, and the next one has begun
    if (job && job.id === started && !busy) {
      started = null;
      if (job.state !== "done") saves = "";
      if (job.state === "failed") complain(job.said);
    }
    running.hidden = !own;
    if (own) {
      const share = shareDone(own);
      if (share === null) bar.removeAttribute("value");
      else bar.value = share;
      setText(said, own.said || own.label);
    }
    const nothing = !store.readOnly && !chosen().length;
    zip.disabled = write.disabled = busy || nothing;
    zip.title = write.title = busy ? "A job is running" : nothing ? "Select at least one target" : "";
    report.disabled = !store.stageOf() || busy;
    report.title = store.stageOf() ? (busy ? "A job is running" : "The report alone, to read and to print") : "Solve first";
    setAttribute(list, "aria-busy", isOpen() && !table && !failed && Boolean(store.get("scan")));
  };

  for (const field of [scope, frame, full, crop, last]) field.addEventListener("change", () => refresh());
  scope.addEventListener("change", () => {
    ready.hidden = true;
  });
  last.addEventListener("change", () => show());
  view.on((_, names) => {
    if (!names.has("step")) return;
    if (!isOpen()) table = null; // what it says would be out of date
    show();
    refresh();
  });
  store.on("shown", () => {
    written.hidden = true;
    if (ofShown()) ready.hidden = true;
  });
  store.watch(["poses:*", "picks:*", "photos", "scan", "shown", "stations"], () => refresh());
  store.watch(["job", "scan", "shown", "poses:*", "picks:*", "progress:*"], show);
  show();
  refresh();
  return [part, files.part];
};
