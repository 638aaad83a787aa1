/**
 * What this tab tells the workbench of itself when it connects, so that it is recognised after a reload, a lost
 * connection or a restart of the workbench: the same person with the same name, photograph and steps to undo.
 */

const TAB = "ladarreg-tab";
const NAME = "ladarreg-name";
const PHOTO = "ladarreg-photo";

const random = () => [...crypto.getRandomValues(new Uint8Array(16))].map((byte) => byte.toString(16).padStart(2, "0")).join("");

/** A browser copies a tab with its storage; this number it does not copy. */
const page = random();
let tab = random();

/** @param {string} key */
const read = (key) => {
  try {
    return sessionStorage.getItem(key) ?? "";
  } catch {
    return ""; // storage is disabled: the tab is recognised until it is reloaded
  }
};

/** @param {string} key @param {string} value */
const write = (key, value) => {
  try {
    sessionStorage.setItem(key, value);
  } catch {
    // storage is disabled
  }
};

tab = read(TAB) || tab;
write(TAB, tab);

/** @returns {URLSearchParams} for the address of the websocket */
export const introduction = () => {
  const fields = { tab, page, name: read(NAME), photo: read(PHOTO) };
  return new URLSearchParams(Object.entries(fields).filter(([, value]) => value));
};

/** Remember the name that this person has chosen. @param {string} name */
export const rememberName = (name) => write(NAME, name);

/** Remember the photograph that this person sees. @param {string | null} photo its id */
export const rememberPhoto = (photo) => write(PHOTO, photo ?? "");
