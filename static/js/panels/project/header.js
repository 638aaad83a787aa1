/** The header: project, scan, photographs, the four steps, and general controls. */

import { request, requestForPhoto } from "../../net/requests.js";
import { store } from "../../net/store.js";
import { isActive, isConnecting } from "../../state/acquisition.js";
import { jobOn } from "../../state/pipeline.js";
import { cloudNames, othersText } from "../../state/scan_name.js";
import { button } from "../../ui/controls.js";
import { element, partOf, setAttribute, setChildren, setText } from "../../ui/dom.js";
import { icon } from "../../ui/icons.js";
import { notice } from "../../ui/notices.js";
import { counted } from "../../ui/numbers.js";
import { chosenTheme, nextTheme, onTheme } from "../../ui/theme.js";
import { clientsText, mountClients } from "./clients.js";
import { namesOf } from "../files/file_kinds.js";
import { openFiles } from "../files/files.js";
import { mountHistory } from "./history.js";
import { openKeys } from "./key_reference.js";
import { mountPhotoList } from "../files/photo_list.js";
import { openProjects } from "./start_page.js";
import { mountStepTabs } from "./step_tabs.js";

const MAX_LETTERS = 80;
const THEMES = { system: "Theme: system", dark: "Theme: dark", light: "Theme: light" };

const projectName = () => {
  const input = element(
    "input",
    {
      class: "project-name",
      "aria-label": "Project name",
      title: "Project name: click to rename",
      maxLength: MAX_LETTERS,
      spellcheck: false,
      autocomplete: "off",
    },
  );
  const show = () => {
    const name = store.get("project")?.name ?? "";
    if (document.activeElement !== input) input.value = name;
    input.style.setProperty("--letters", String(Math.max(6, Math.min(26, name.length + 1))));
    document.title = name ? `${name} · ladarreg` : "ladarreg";
  };
  input.addEventListener("change", () => {
    const name = input.value.trim();
    if (name && name !== store.get("project")?.name) request("rename", { name });
  });
  input.addEventListener("blur", show);
  input.addEventListener("keydown", (event) => {
    if (event.key === "Escape") input.value = store.get("project")?.name ?? "";
    if (event.key === "Enter" || event.key === "Escape") input.blur();
  });
  store.watch(["project"], show);
  show();
  return input;
};

const scanChip = () => {
  const chip = element("button", { type: "button", class: "chip scan-chip", on: { click: () => openFiles("scan") } });
  const show = () => {
    const scan = store.get("scan");
    const others = othersText(scan);
    const size = scan?.columns ? `${scan.columns}×${scan.rows}` : "";
    setChildren(
      chip,
      icon(scan ? (scan.error ? "bad" : "file") : "plus"),
      element("span", { class: "clip" }, scan ? scan.name : "Open a scan"),
      others ? element("span", { class: "dim" }, others) : null,
      size ? element("span", { class: "dim" }, size) : null,
    );
    const place = scan?.world ? `\nIn the world: ${scan.world.position}; ${scan.world.heading}; ${scan.world.tilt}` : "";
    const notes = scan?.notes?.length ? `\n${scan.notes.join("\n")}` : "";
    chip.title = scan
      ? `${scan.error ?? `${cloudNames(scan)}, ${counted(scan.returns ?? 0, "return")}${place}${notes}`}\nClick to open another scan.`
      : `Open a scan: ${namesOf("scan")}`;
    chip.classList.toggle("attention", !scan);
  };
  store.watch(["scan", "formats"], show);
  show();
  return chip;
};

const historyButtons = () => {
  const undo = button({ label: "Undo", icon: "undo", bare: true, kind: "edits", act: () => request("undo") });
  const redo = button({ label: "Redo", icon: "redo", bare: true, kind: "edits", act: () => request("redo") });
  /** @type {{control: HTMLButtonElement, word: string, key: "undo" | "redo", keys: string}[]} */
  const both = [
    { control: undo, word: "Undo", key: "undo", keys: "Ctrl Z" },
    { control: redo, word: "Redo", key: "redo", keys: "Ctrl Shift Z" },
  ];
  const show = () => {
    const project = store.get("project");
    for (const { control, word, key, keys } of both) {
      const what = project?.[key];
      control.disabled = !what;
      control.title = what ? `${word}: ${what} (${keys})` : `Nothing to ${word.toLowerCase()}`;
      control.setAttribute("aria-label", what ? `${word}: ${what}` : word);
    }
  };
  store.watch(["project"], show);
  show();
  return [undo, redo];
};

/** @returns {string} why the automatic registration cannot run now; empty if it can */
const autoMissing = () => {
  const photo = store.photo();
  if (!store.get("scan")) return "Open a scan first.";
  if (!photo) return "Open a photograph first.";
  if (!photo.camera) return `Enter the focal length of ${photo.name} first: the file does not contain it.`;
  const job = jobOn(store.get("job"), store.shown());
  return job ? `“${job.label}” is ${"state" in job ? "running" : "waiting"}: wait until it ends, or stop it in the status bar.` : "";
};

const autoButton = () => {
  const control = button({
    label: "Register automatically",
    kind: "primary edits",
    act: () => {
      const missing = autoMissing();
      if (missing) notice(missing, "warn");
      else requestForPhoto("run", { job: "auto" });
    },
  });
  const show = () => {
    const missing = autoMissing();
    setAttribute(control, "aria-disabled", missing ? "true" : null);
    control.title = missing || "Find the pose from the images alone; drawn matches are not changed";
  };
  store.watch(["scan", "photos", "shown", "job"], show);
  show();
  return control;
};

const themeButton = () => {
  const control = button({ label: "Theme", icon: "system", bare: true, act: nextTheme });
  const show = () => {
    const theme = chosenTheme();
    setChildren(control, icon(theme));
    control.title = `${THEMES[theme]}; click to change`;
    control.setAttribute("aria-label", `${THEMES[theme]}`);
  };
  onTheme(show);
  show();
  return control;
};

/** Stop, whatever step is open, while the unit moves or may go on by itself. */
const stopButton = () => {
  const stop = button({
    label: "Stop the unit",
    text: "Stop  F8",
    icon: "stop",
    kind: "small stop-button header-stop edits",
    title: "Halt the unit and switch the laser off (F8). It is no safety device: a hardware stop must be within reach.",
    act: () => request("acquire_stop"),
  });
  const show = () => (stop.hidden = !isActive() && !isConnecting());
  store.watch(["acquisition"], show);
  show();
  return stop;
};

/** @param {HTMLElement} header */
export const mountHeader = (header) => {
  const history = button({
    label: "History",
    title: "All edits; go back to any of them (H)",
    icon: "history",
    kind: "history-button",
  });
  const clients = button({ label: "1 client", title: "Connected clients", icon: "people", kind: "chip clients-button" });
  header.append(
    element(
      "div",
      { class: "header-files" },
      element(
        "button",
        { type: "button", class: "brand brand-button", "aria-label": "Projects", title: "Projects: open, new, duplicate", on: { click: () => openProjects(openFiles) } },
        element("img", { src: "logo.svg", alt: "", width: 22, height: 22 }),
        element("span", { class: "brand-word" }, "ladar", element("b", {}, "reg")),
        icon("more"),
      ),
      projectName(),
      scanChip(),
      mountPhotoList(),
    ),
    mountStepTabs(),
    element(
      "div",
      { class: "header-tools" },
      stopButton(),
      ...historyButtons(),
      history,
      autoButton(),
      element("span", { class: "read-only-mark", title: "This page may look at everything, but change nothing" }, "Read only"),
      clients,
      themeButton(),
      button({ label: "Keyboard reference (?)", icon: "help", bare: true, "data-needs": "keyboard", act: openKeys }),
    ),
  );
  mountHistory(history);
  mountClients(clients);
  const count = () => {
    setText(partOf(clients, "span"), clientsText());
    clients.classList.toggle("following", clientsText().startsWith("Following"));
  };
  store.watch(["people"], count);
  count();
};
