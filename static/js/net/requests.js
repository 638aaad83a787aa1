/** Requests to the workbench whose refusal is shown as a notice and needs no further handling. */

import { notice } from "../ui/notices.js";
import { ask } from "./connection.js";
import { store } from "./store.js";

/**
 * Send a command; a refusal becomes a notice.
 * @param {string} command
 * @param {Record<string, any>} [args]
 * @returns {Promise<any>} the answer, or null if it was refused
 */
export const request = async (command, args = {}) => {
  try {
    return await ask(command, args);
  } catch (error) {
    notice(error.message, "bad");
    return null;
  }
};

/** Send a command about the shown photograph; see `request`. */
export const requestForPhoto = (command, args = {}) => request(command, { photo: store.shown(), ...args });
