/** Asking for changes where a refusal is told to the person and nothing else hangs on the answer. */

import { ask } from "./connection.js";
import { notice } from "../ui/notices.js";
import { store } from "./store.js";

/**
 * Ask; a refusal becomes a notice.
 * @param {string} what
 * @param {Record<string, any>} [args]
 * @returns {Promise<any>} the answer, or null where it was refused
 */
export const wish = async (what, args = {}) => {
  try {
    return await ask(what, args);
  } catch (error) {
    notice(error.message, "bad");
    return null;
  }
};

/** Ask for something about the shown photograph; see `wish`. */
export const wishHere = (what, args = {}) => wish(what, { photo: store.shown(), ...args });
