/** The projects: recent ones, a new one, one of a folder, the sample, the jobs of a batch. It is the first page where none is named. */

import { ask as command } from "../../net/connection.js";
import { store } from "../../net/store.js";
import { button } from "../../ui/controls.js";
import { makeDialog } from "../../ui/dialog.js";
import { element, newId, partOf, setChildren, setText } from "../../ui/dom.js";
import { messageOf } from "../../ui/faults.js";
import { icon } from "../../ui/icons.js";
import { confirmation } from "../files/confirmation.js";
import { batchList } from "./batch_list.js";

/**
 * @typedef {import("../../net/requests.js").Commands} Commands
 * @typedef {{id: string, name: string, folder: string, state: string, edited: string, missing: boolean, current: boolean,
 *   picture: boolean}} Project as `list_projects` answers
 * @typedef {"open_project" | "new_project" | "open_sample" | "open_job"} Opening
 */

const MAX_LETTERS = 80;
const DATE = new Intl.DateTimeFormat(undefined, { dateStyle: "medium", timeStyle: "short" });

/** @type {{open: () => void, refresh: () => Promise<void>} | null} */
let page = null;

/** @param {string} edited */
const dated = (edited) => (edited ? DATE.format(new Date(edited)) : "");

/**
 * A form of one field and its button.
 * @param {{label: string, placeholder: string, submit: string, act: (typed: string) => void, maxLength?: number}} options
 */
const fieldForm = ({ label, placeholder, submit, act, ...rest }) => {
  const id = newId("field");
  const input = element("input", { id, placeholder, autocomplete: "off", spellcheck: false, ...rest });
  const form = element(
    "form",
    { class: "start-form" },
    element("label", { for: id }, label),
    element("div", { class: "row" }, input, element("button", { type: "submit", class: "button" }, submit)),
  );
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    act(input.value.trim());
  });
  return form;
};

/**
 * @param {Project} project
 * @param {{open: (name: "open_project", fields: Commands["open_project"]) => void, close: () => void, change: (name: "duplicate_project" | "forget_project", wanted: string, done: string) => void}} acts
 */
const card = (project, { open, change, close }) => {
  const { id, name, folder, state, edited, missing, current, picture } = project;
  const opener = element(
    "button",
    {
      type: "button",
      class: "project-card-open",
      disabled: missing,
      on: { click: () => (current ? close() : open("open_project", { wanted: id })) },
    },
    picture
      ? element("img", { src: `picture/project/${id}?rev=${encodeURIComponent(edited)}`, alt: "", loading: "lazy" })
      : element("span", { class: "project-card-blank" }, icon(missing ? "bad" : "file")),
    element("span", { class: "project-card-name clip", title: name }, name, current ? " · open" : ""),
    element("span", { class: missing ? "bad" : "dim" }, missing ? "Folder missing" : state),
    element("span", { class: "dim figures" }, dated(edited)),
  );
  opener.title = missing ? `${folder}: ${state}` : folder;
  return element(
    "li",
    { class: `project-card ${missing ? "missing" : ""}`.trim() },
    opener,
    element(
      "div",
      { class: "row project-card-acts" },
      missing ? null : button({ label: `Duplicate ${name}`, text: "Duplicate", kind: "small plain", act: () => change("duplicate_project", id, `${name} was duplicated.`) }),
      button({
        label: `Remove ${name} from this list`,
        title: "Remove from this list; the folder stays",
        text: "Remove",
        kind: "small plain",
        act: () => change("forget_project", id, `${name} was removed from the list; its folder stays.`),
      }),
    ),
  );
};

/** @param {() => void} chooseFiles */
const build = (chooseFiles) => {
  const cards = element("ul", { class: "project-cards", "aria-label": "Recent projects" });
  const none = element("p", { class: "dim" }, "No projects yet: drop a scan and its photographs anywhere on this page.");
  const { box, ask } = confirmation("Open another project?", "Open it all the same");
  const status = element("p", { class: "dim", role: "status" });
  const isStart = () => store.get("project")?.start === true;

  const say = (/** @type {string} */ text, level = "") => {
    setText(status, text);
    status.className = level || "dim";
  };
  /**
   * Send a command; a refusal is shown in the page, since notices lie behind it.
   * @template {keyof Commands} Name
   * @param {Name} name
   * @param {Commands[Name]} [fields]
   */
  const tried = async (name, fields) => {
    dialog.body.inert = true;
    try {
      return await command(name, fields);
    } catch (error) {
      say(messageOf(error), "form-wrong");
      return null;
    } finally {
      dialog.body.inert = false;
    }
  };
  /** @template {Opening} Name @param {Name} name @param {Commands[Name]} [fields] */
  const open = async (name, fields) => {
    say("Opening …");
    const answer = await tried(name, fields);
    if (!answer) return;
    say("");
    if (answer.batch) refresh();
    else if (answer.asks) ask(answer.asks, () => open(name, /** @type {Commands[Name]} */ ({ ...fields, sure: true })));
    else if (answer.opened === store.get("project")?.id) dialog.close();
  };
  /** @param {"duplicate_project" | "forget_project"} name @param {string} wanted @param {string} done what is said then */
  const change = async (name, wanted, done) => {
    if (!(await tried(name, { wanted }))) return;
    say(done);
    refresh();
  };
  const refresh = async () => {
    const answer = await tried("list_projects", {});
    if (!answer) return;
    setChildren(cards, ...answer.projects.map((/** @type {Project} */ project) => card(project, { open, change, close: dialog.close })));
    none.hidden = answer.projects.length > 0;
    folder.hidden = !answer.anywhere;
    batch.part.hidden = !answer.batch;
    if (answer.batch) batch.refresh();
  };
  /**
   * Send a command without blocking the page: the list is fetched while the search text is typed.
   * @template {keyof Commands} Name
   * @param {Name} name
   * @param {Commands[Name]} fields
   */
  const quietly = async (name, fields) => {
    try {
      return await command(name, fields);
    } catch (error) {
      say(messageOf(error), "form-wrong");
      return null;
    }
  };
  const batch = batchList({ ask: quietly, open: (wanted) => open("open_job", { wanted }) });
  const folder = fieldForm({
    label: "Open the folder of a project or a batch on the machine of the workbench",
    placeholder: "/data/office-7",
    submit: "Open",
    act: (path) => open("open_project", { folder: path }),
  });
  const create = fieldForm({
    label: "New project",
    placeholder: "Name",
    submit: "Begin",
    maxLength: MAX_LETTERS,
    act: (name) => open("new_project", { name }),
  });
  const choose = button({ label: "Choose files…", kind: "primary", autofocus: true, act: chooseFiles });
  const dialog = makeDialog(
    "Projects",
    { kind: "start-page" },
    element(
      "p",
      { class: "start-brand" },
      element("img", { src: "logo.svg", alt: "", width: 34, height: 34 }),
      element("span", {}, element("b", {}, "ladarreg"), " registers a laser scan with photographs."),
    ),
    element(
      "div",
      { class: "start-acts" },
      element(
        "div",
        { class: "drop-zone start-drop" },
        element("p", { class: "drop-title" }, "Drop a scan and its photographs"),
        element("div", { class: "row" }, choose, button({ label: "Open the sample", act: () => open("open_sample") })),
      ),
      create,
      folder,
    ),
    box,
    status,
    batch.part,
    element("h3", {}, "Recent"),
    none,
    cards,
  );
  dialog.dialog.addEventListener("cancel", (event) => isStart() && event.preventDefault());
  dialog.dialog.addEventListener("close", () => isStart() && dialog.open()); // a second Escape cannot be prevented
  const closer = partOf(dialog.dialog, ".dialog-head button");
  let wasStart = false;
  const show = () => {
    closer.hidden = isStart();
    dialog.dialog.classList.toggle("first", isStart());
    if (dialog.dialog.open && wasStart && !isStart()) dialog.close();
    wasStart = isStart();
  };
  store.watch(["project"], show);
  show();
  return { open: dialog.open, refresh };
};

/** Show the projects. @param {() => void} chooseFiles opens the dialog for files */
export const openProjects = (chooseFiles) => {
  page ??= build(chooseFiles);
  page.open();
  page.refresh();
};
