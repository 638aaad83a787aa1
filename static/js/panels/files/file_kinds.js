/** The kinds of file that the workbench opens, as it lists them itself (slice `formats`). */

import { store } from "../../net/store.js";

/** @typedef {"scan" | "photo" | "camera" | "matches"} Kind */

/** @returns {{kind: string, label: string, names: string[], extensions: string[]}[]} */
const formats = () => store.get("formats") ?? [];

/** @param {string} kind @returns {string} its label, in lower case */
export const labelOf = (kind) => formats().find((each) => each.kind === kind)?.label.toLowerCase() ?? kind;

/** @param {Kind} kind @returns {string} such as "E57, NPZ, PCD, descriptor JSON" */
export const namesOf = (kind) => formats().find((each) => each.kind === kind)?.names.join(", ") ?? "";

/** @returns {string} the file types of the file chooser; any other file may be chosen, too */
export const accepted = () => [...new Set(formats().flatMap(({ extensions }) => extensions))].join(",");

/** @returns {string} what can be opened, in one line */
export const readable = () =>
  `Scans: ${namesOf("scan")}. Photographs: ${namesOf("photo")}. Also camera files and matches. ` +
  "What a file is, its content decides.";
