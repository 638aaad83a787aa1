/** The header: project, scan, photographs, the four steps, and what concerns the whole. */

import { attribute, button, element, put, say } from "../ui/dom.js";
import { wish, wishHere } from "../net/requests.js";
import { mountHistory } from "./history.js";
import { icon } from "../ui/icons.js";
import { openKeys } from "./keys_dialog.js";
import { notice } from "../ui/notices.js";
import { counted } from "../ui/numbers.js";
import { openFiles } from "./files.js";
import { mountPeople } from "./clients.js";
import { mountPhotoTabs } from "./photo_tabs.js";
import { mountStepTabs } from "./step_tabs.js";
import { store } from "../net/store.js";
import { nextTheme } from "../ui/theme.js";
import { runs } from "../state/pipeline.js";
import { view } from "../state/view.js";

const MOST_NAME = 80;
const THEMES = { system: "Theme: as the system has it", dark: "Theme: dark", light: "Theme: light" };

const projectName = () => {
  const input = element(
    "input",
    {
      class: "project-name",
      "aria-label": "Project name",
      title: "Project name: click to rename",
      maxLength: MOST_NAME,
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
    if (name && name !== store.get("project")?.name) wish("rename", { name });
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
    const size = scan?.columns ? `${scan.columns}×${scan.rows}` : "";
    put(
      chip,
      icon(scan ? (scan.error ? "bad" : "file") : "plus"),
      element("span", { class: "clip" }, scan ? scan.name : "Open a scan"),
      size ? element("span", { class: "dim" }, size) : null,
    );
    const notes = scan?.notes?.length ? `\n${scan.notes.join("\n")}` : "";
    chip.title = scan
      ? `${scan.error ?? `${scan.name}, ${counted(scan.returns ?? 0, "return")}${notes}`}\nClick to open another scan.`
      : "Open a scan: E57, NPZ, PCD or a descriptor";
    chip.classList.toggle("wanted", !scan);
  };
  store.watch(["scan"], show);
  show();
  return chip;
};

const historyButtons = () => {
  const undo = button({ label: "Undo", icon: "undo", bare: true, act: () => wish("undo") });
  const redo = button({ label: "Redo", icon: "redo", bare: true, act: () => wish("redo") });
  const show = () => {
    const project = store.get("project");
    for (const [made, word, key, keys] of [[undo, "Undo", "undo", "Ctrl Z"], [redo, "Redo", "redo", "Ctrl Shift Z"]]) {
      const what = project?.[key];
      made.disabled = !what;
      made.title = what ? `${word}: ${what} (${keys})` : `Nothing to ${word.toLowerCase()}`;
      made.setAttribute("aria-label", what ? `${word}: ${what}` : word);
    }
  };
  store.watch(["project"], show);
  show();
  return [undo, redo];
};

/** What keeps the automatic registration from running; empty where nothing does. */
const autoMissing = () => {
  const photo = store.photo();
  if (!store.get("scan")) return "Open a scan first, then it can be registered.";
  if (!photo) return "Open a photograph first, then it can be registered.";
  if (!photo.camera) return `Tell the focal length of ${photo.name} first: nothing in the file says it.`;
  const job = store.get("job");
  return runs(job) ? `“${job.label}” is running: wait until it ends, or stop it in the status bar.` : "";
};

const autoButton = () => {
  const made = button({
    label: "Register automatically",
    kind: "primary",
    act: () => {
      const missing = autoMissing();
      if (missing) notice(missing, "warn");
      else wishHere("run", { job: "auto" });
    },
  });
  const show = () => {
    const missing = autoMissing();
    attribute(made, "aria-disabled", missing ? "true" : null);
    made.title = missing || "Find the pose from the pictures alone; drawn matches stay what they are";
  };
  store.watch(["scan", "photos", "shown", "job"], show);
  show();
  return made;
};

const themeButton = () => {
  const made = button({ label: "Theme", icon: "system", bare: true, act: nextTheme });
  const show = () => {
    const { theme } = view.get();
    put(made, icon(theme));
    made.title = `${THEMES[theme]}; click for the next`;
    made.setAttribute("aria-label", `${THEMES[theme]}`);
  };
  view.on((_, changed) => changed.has("theme") && show());
  show();
  return made;
};

/** @param {HTMLElement} header */
export const mountHeader = (header) => {
  const history = button({
    label: "History",
    title: "Every step of the work; go back to any (H)",
    icon: "history",
    kind: "history-button",
  });
  const people = button({ label: "1 here", title: "Who is here", icon: "people", kind: "chip people-button" });
  header.append(
    element(
      "div",
      { class: "header-files" },
      element(
        "span",
        { class: "brand" },
        element("img", { src: "logo.svg", alt: "", width: 22, height: 22 }),
        element("span", { class: "brand-word" }, "ladar", element("b", {}, "reg")),
      ),
      projectName(),
      scanChip(),
      mountPhotoTabs(),
    ),
    mountStepTabs(),
    element(
      "div",
      { class: "header-tools" },
      ...historyButtons(),
      history,
      autoButton(),
      people,
      themeButton(),
      button({ label: "Keyboard reference (?)", icon: "help", bare: true, act: openKeys }),
    ),
  );
  mountHistory(history);
  mountPeople(people);
  const count = () => say(people.querySelector("span"), `${store.get("people")?.count ?? 1} here`);
  store.watch(["people"], count);
  count();
};
