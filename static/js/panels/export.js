/** Taking results home: what is written, as a zip or into a folder; and why not, where nothing is coloured. */

import { button, element, newId, put, say } from "../ui/dom.js";
import { runs } from "../state/pipeline.js";
import { wishHere } from "../net/requests.js";
import { icon } from "../ui/icons.js";
import { notice } from "../ui/notices.js";
import { sentences } from "../ui/numbers.js";
import { store } from "../net/store.js";

const FILES = [
  ["registration.json", "pose, covariance, matches, how it was found", false],
  ["matches.json", "the matches, to be opened again", false],
  ["registered.png", "the photograph on the scan's grid", true],
  ["labels.png", "seen, hidden, outside, grazing or uncertain, cell by cell", true],
  ["uncertainty.png", "how many pixels the registration may be off, cell by cell", true],
  ["model.glb", "the textured surface", true],
  ["cloud.ply", "the coloured points", true],
];
const FOLDER_KEY = "ladarreg-folder";

const listed = (accepted) =>
  FILES.map(([name, said, needs]) => {
    const written = accepted || !needs;
    return element(
      "li",
      { class: written ? "" : "left-out" },
      element("span", { class: `sign ${written ? "ok" : "dim"}` }, icon(written ? "tick" : "cross")),
      element("code", {}, name),
      element("span", { class: "dim" }, written ? said : `${said}: not written`),
    );
  });

const kept = () => {
  try {
    return localStorage.getItem(FOLDER_KEY) ?? "";
  } catch {
    return "";
  }
};

/** @returns {HTMLElement[]} the options and the list */
export const mountExport = () => {
  let wanted = null; // the photograph whose zip is to be saved as soon as it is ready
  const verdict = element("div", {});
  const zip = button({ label: "Download zip", kind: "primary", icon: "download", act: () => download() });
  const ready = element("a", { class: "ready", hidden: true, download: "" }, "Save the zip that is ready");
  const id = newId("field");
  const folder = element(
    "input",
    {
      id,
      class: "folder",
      placeholder: "/home/me/results/office-7",
      spellcheck: false,
      autocomplete: "off",
      value: kept(),
    },
  );
  const force = element("input", { type: "checkbox" });
  const write = element(
    "button",
    { type: "submit", class: "button" },
    icon("folder"),
    element("span", {}, "Write into a folder"),
  );
  const wrong = element("p", { class: "form-wrong", role: "alert", hidden: true });
  const form = element(
    "form",
    { class: "export-form" },
    element("label", { for: id }, "Folder on the workbench's machine"),
    folder,
    element("div", { class: "row" }, write, element("label", { class: "inline" }, force, "replace earlier results")),
    element(
      "p",
      { class: "dim" },
      "A folder is replaced only if it holds exported results and nothing else; the old ones stay until the new ones " +
        "are complete.",
    ),
    wrong,
  );
  const left = element(
    "section",
    { class: "dock-part export-part", "aria-label": "Export" },
    element("div", { class: "part-head" }, element("h2", {}, "Export")),
    element("div", { class: "part-body" }, verdict, element("div", { class: "row" }, zip, ready), form),
  );
  const files = element("ul", { class: "export-list" });
  const right = element(
    "section",
    { class: "dock-part export-files", "aria-label": "What is written" },
    element("div", { class: "part-head" }, element("h2", {}, "What is written")),
    element("div", { class: "part-body" }, files),
  );

  const download = async () => {
    ready.hidden = true;
    wanted = store.shown();
    if (!(await wishHere("run", { job: "export" }))) wanted = null;
  };
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    const name = folder.value.trim();
    wrong.hidden = name !== "";
    say(wrong, name ? "" : "Give the folder that the results shall go to.");
    if (!name) return;
    try {
      localStorage.setItem(FOLDER_KEY, name);
    } catch {
      // storage is off: it is asked for again
    }
    if (await wishHere("export_folder", { folder: name, force: force.checked })) notice(`Writing into ${name}.`);
  });
  store.onEvent("export_ready", ({ photo, url }) => {
    if (photo !== store.shown()) return;
    ready.href = url;
    ready.hidden = false;
    if (wanted === photo) ready.click();
    wanted = null;
  });
  store.on("shown", () => {
    ready.hidden = true;
  });

  const show = () => {
    const stage = store.stageOf();
    const accepted = Boolean(stage?.accepted);
    const busy = runs(store.get("job"));
    zip.disabled = write.disabled = !stage || busy;
    zip.title = stage ? (busy ? "Something is running" : "") : "Solve first";
    const word = !stage
      ? "There is no pose yet: solve first, or register automatically."
      : accepted
        ? `${stage.label} is accepted: everything is written.`
        : `${stage.label} is not accepted, so nothing is coloured by it: only the figures are written, with ` +
          `the reasons.`;
    put(
      verdict,
      element(
        "div",
        { class: `verdict ${accepted ? "ok" : stage ? "bad" : "none"}` },
        icon(accepted ? "tick" : stage ? "bad" : "info"),
        element("p", {}, word, stage && !accepted ? ` ${sentences(stage.reasons ?? [])}` : ""),
      ),
    );
    put(files, ...listed(accepted));
  };
  store.watch(["poses:*", "shown", "job"], show);
  show();
  return [left, right];
};
