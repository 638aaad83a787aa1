/**
 * The project that this page belongs to. Nearly everything that a page keeps (views, pictures, selections, drawings)
 * belongs to one project, so that the page starts afresh when the workbench opens another.
 */

import { rememberPhoto } from "../net/identity.js";
import { store } from "../net/store.js";
import { view } from "./view.js";

const TOLD = "ladarreg-project-told";

let present = null;

const startAfresh = (id, told) => {
  view.exchange(present, id);
  rememberPhoto(null);
  try {
    if (told) sessionStorage.setItem(TOLD, told);
  } catch {
    // storage is disabled: nobody is told
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

/** @returns {string} what to tell after the project was changed by somebody else; once */
export const toldOfProject = () => {
  try {
    const told = sessionStorage.getItem(TOLD) ?? "";
    sessionStorage.removeItem(TOLD);
    return told;
  } catch {
    return "";
  }
};
