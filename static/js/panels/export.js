/** Export of results, as a zip or into a folder: which files are written, and why some are not. */

import { requestForPhoto } from "../net/requests.js";
import { store } from "../net/store.js";
import { isRunning } from "../state/pipeline.js";
import { progressNow } from "../state/progress.js";
import { button } from "../ui/controls.js";
import { element, newId, setChildren, setText } from "../ui/dom.js";
import { icon } from "../ui/icons.js";
import { lightOf } from "../ui/lights.js";
import { notice } from "../ui/notices.js";
import { sentences } from "../ui/numbers.js";

const MATCHES = "matches.json";
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
const OFFSET = ["offset.json", "what was subtracted from the coordinates of the world", true];
const FOLDER_KEY = "ladarreg-folder";

/** What each file is; it has a tick once it was exported from the present pose. */
const listed = (accepted, any, posed, frame, exported) =>
  [...FILES, ...(frame === "world" ? [OFFSET] : [])].map(([name, description, needsAcceptance]) => {
    const known = posed || (name === MATCHES && store.picksOf().length > 0);
    const written = any && known && (accepted || !needsAcceptance);
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
  });

const storedFolder = () => {
  try {
    return localStorage.getItem(FOLDER_KEY) ?? "";
  } catch {
    return "";
  }
};

/** @returns {HTMLElement[]} the form and the list of files */
export const mountExport = () => {
  let requested = null; // the photograph whose zip is saved as soon as it is ready
  const verdict = element("div", {});
  const zip = button({ label: "Download zip", kind: "primary", icon: "download", act: () => download() });
  const ready = element("a", { class: "ready", hidden: true, download: "" }, "Save the finished zip");
  const report = button({ label: "Write report", icon: "file", act: () => writeReport() });
  const written = element("a", { class: "ready", hidden: true, target: "_blank", rel: "noopener" }, "Open the report");
  const id = newId("field");
  const folder = element(
    "input",
    {
      id,
      class: "folder",
      placeholder: "/home/me/results/office-7",
      spellcheck: false,
      autocomplete: "off",
      value: storedFolder(),
    },
  );
  const force = element("input", { type: "checkbox" });
  const write = element(
    "button",
    { type: "submit", class: "button" },
    icon("folder"),
    element("span", {}, "Write to folder"),
  );
  const last = element("input", { type: "checkbox" });
  const lastRow = element(
    "label",
    { class: "inline", title: "The files then state on which matches they rest", hidden: true },
    last,
    "export the last solved state",
  );
  const frame = element(
    "select",
    { class: "select small" },
    element("option", { value: "scanner" }, "scanner"),
    element("option", { value: "world" }, "world"),
  );
  const frameRow = element(
    "label",
    { class: "inline", title: "Coordinates of model.glb and cloud.ply", hidden: true },
    "Model and cloud in the frame of the",
    frame,
  );
  const place = element("p", { class: "dim", hidden: true });
  const wrong = element("p", { class: "form-wrong", role: "alert", hidden: true });
  const form = element(
    "form",
    { class: "export-form" },
    element("label", { for: id }, "Folder on the workbench's computer"),
    folder,
    element("div", { class: "row" }, write, element("label", { class: "inline" }, force, "replace earlier results")),
    element(
      "p",
      { class: "dim" },
      "A folder is replaced only if it contains exported results and nothing else. The old results are kept until the " +
        "new ones are complete.",
    ),
    wrong,
  );
  const left = element(
    "section",
    { class: "dock-part export-part", "aria-label": "Export" },
    element("div", { class: "part-head" }, element("h2", {}, "Export")),
    element("div", { class: "part-body" }, verdict, lastRow, frameRow, element("div", { class: "row" }, zip, ready, report, written), place, form),
  );
  const files = element("ul", { class: "export-list" });
  const right = element(
    "section",
    { class: "dock-part export-files", "aria-label": "Exported files" },
    element("div", { class: "part-head" }, element("h2", {}, "Exported files")),
    element("div", { class: "part-body" }, files),
  );

  /** A page that may only look downloads what others have exported. */
  const downloadLatest = async () => {
    const url = `export/${encodeURIComponent(store.shown() ?? "")}.zip`;
    const { ok } = await fetch(url, { method: "HEAD", cache: "no-store" }).catch(() => ({ ok: false }));
    if (!ok) {
      notice("Nothing has been exported from this photograph yet: ask someone who is allowed to edit to export it.", "warn");
      return;
    }
    ready.href = url;
    ready.click();
  };

  const download = async () => {
    ready.hidden = true;
    if (store.readOnly) {
      await downloadLatest();
      return;
    }
    requested = store.shown();
    if (!(await requestForPhoto("run", { job: "export", last_solved: last.checked, frame: frame.value }))) requested = null;
  };
  const writeReport = async () => {
    written.hidden = true;
    await requestForPhoto("run", { job: "report" });
  };
  store.onEvent("report_ready", ({ photo, url }) => {
    if (photo !== store.shown()) return;
    written.href = url;
    written.hidden = false;
  });
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    const name = folder.value.trim();
    wrong.hidden = name !== "";
    setText(wrong, name ? "" : "Enter the folder for the results.");
    if (!name) return;
    try {
      localStorage.setItem(FOLDER_KEY, name);
    } catch {
      // storage is disabled: it has to be entered again next time
    }
    const asked = { folder: name, force: force.checked, last_solved: last.checked, frame: frame.value };
    if (await requestForPhoto("export_folder", asked)) notice(`Writing to ${name}.`);
  });
  store.onEvent("export_ready", ({ photo, url }) => {
    if (photo !== store.shown()) return;
    ready.href = url;
    ready.hidden = false;
    if (requested === photo) ready.click();
    requested = null;
  });
  store.on("shown", () => {
    ready.hidden = written.hidden = true;
  });
  last.addEventListener("change", () => show());
  frame.addEventListener("change", () => show());

  const show = () => {
    const stage = store.stageOf();
    const accepted = Boolean(stage?.accepted);
    const exported = Boolean(progressNow().steps.find(({ name }) => name === "export")?.done);
    const light = lightOf(stage?.summary?.light);
    const busy = isRunning(store.get("job"));
    const stale = stage?.stale ?? "";
    const world = store.get("scan")?.world;
    frameRow.hidden = place.hidden = !world;
    if (!world) frame.value = "scanner";
    setText(place, world ? `The scanner stands at ${world.position} in the world; ${world.heading}.` : "");
    lastRow.hidden = !stale;
    if (!stale) last.checked = false;
    const outdated = stale && !last.checked;
    const matches = store.picksOf().length;
    const empty = !stage && !matches;
    zip.disabled = write.disabled = empty || busy || Boolean(outdated);
    zip.title = empty ? "Solve first" : busy ? "A job is running" : outdated ? "Solve again first" : "";
    report.disabled = !stage || busy;
    report.title = stage ? (busy ? "A job is running" : "The report alone, to read and to print") : "Solve first";
    const text = !stage
      ? `There is no pose yet: solve first, or register automatically.${matches ? " The matches are written." : ""}`
      : stale
        ? `${stage.label}: out of date. ${stale}, or export the last solved state.`
      : accepted
        ? `${stage.label}: ${stage.summary.words}. ${exported ? "Exported." : "All files will be written."}`
        : `${stage.label}: ${stage.summary.words}. Only the data files ${exported ? "were" : "will be"} written, with the ` +
          "reasons; no coloured output.";
    setChildren(
      verdict,
      element(
        "div",
        { class: `verdict ${light.level}` },
        icon(stage ? light.sign : "info"),
        element("p", {}, text, stage && !accepted && !stale ? ` ${sentences(stage.reasons ?? [])}` : ""),
      ),
    );
    setChildren(files, ...listed(accepted, !outdated, Boolean(stage), frame.value, exported));
  };
  store.watch(["poses:*", "shown", "job", "picks:*", "scan", "progress:*"], show);
  show();
  return [left, right];
};
