/**
 * The project that this page belongs to. Nearly everything that a page keeps (views, pictures, selections, drawings)
 * belongs to one project, so that the page starts afresh when the workbench opens another.
 */

import { rememberPhoto } from "../net/identity.js";
import { store } from "../net/store.js";
import { view } from "./view.js";

const NOTICE = "ladarreg-project-notice";

/** @type {string | null} id */
let present = null;

/** @param {string} id of the project that is opened @param {string} message */
const startAfresh = (id, message) => {
  if (present) view.exchange(present, id);
  rememberPhoto(null);
  try {
    if (message) sessionStorage.setItem(NOTICE, message);
  } catch {
    // storage is disabled: nothing is shown
  }
  location.reload();
};

/** Reload when another project is opened, by this page or by another, also while this one was not connected. */
export const followProject = () => {
  store.onEvent("project", ({ id, name, by }) => {
    startAfresh(id, by === store.me()?.name ? "" : `${by} opened the project ${name}.`);
  });
  store.on("project", (project) => {
    if (present && project && project.id !== present) startAfresh(project.id, `The workbench has opened the project ${project.name}.`);
    present = project?.id ?? present;
  });
};

/** @returns {string} the notice after another project was opened; once */
export const projectNotice = () => {
  try {
    const message = sessionStorage.getItem(NOTICE) ?? "";
    sessionStorage.removeItem(NOTICE);
    return message;
  } catch {
    return "";
  }
};
