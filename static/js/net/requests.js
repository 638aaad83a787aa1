/** Requests to the workbench whose refusal is shown as a notice and needs no further handling. */

import { messageOf } from "../ui/faults.js";
import { notice } from "../ui/notices.js";
import { ask } from "./connection.js";
import { store } from "./store.js";

/** @typedef {import("../protocol.d.ts").Commands} Commands */
/**
 * The commands that name a photograph.
 * @typedef {{[Name in keyof Commands]: Commands[Name] extends {photo: string} ? Name : never}[keyof Commands]} OfPhoto
 */

/**
 * Send a command; a refusal becomes a notice.
 * @template {keyof Commands} Name
 * @param {Name} command
 * @param {Commands[Name]} [args]
 * @returns {Promise<any>} the answer, or null if it was refused
 */
export const request = async (command, args) => {
  try {
    return await ask(command, args);
  } catch (error) {
    notice(messageOf(error), "bad");
    return null;
  }
};

/**
 * Send a command about the shown photograph; see `request`.
 * @template {OfPhoto} Name
 * @param {Name} command
 * @param {Omit<Commands[Name], "photo">} [args]
 */
export const requestForPhoto = (command, args) =>
  request(command, /** @type {Commands[Name]} */ (/** @type {unknown} */ ({ photo: store.shown(), ...args })));
