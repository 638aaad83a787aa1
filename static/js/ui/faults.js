/** What a `catch` has caught: it may be anything, and an error of the 3-D view's frame is of another window's class. */

/**
 * @param {unknown} error
 * @returns {string} its sentence
 */
export const messageOf = (error) =>
  (typeof error === "object" && error !== null && "message" in error ? String(error.message) : String(error));

/**
 * @param {unknown} error of a command
 * @returns {string} the argument that is wrong; empty: none of them
 */
export const fieldOf = (error) =>
  (typeof error === "object" && error !== null && "field" in error ? String(error.field) : "");

/**
 * @param {unknown} error
 * @returns {boolean} whether it was cancelled: nothing went wrong
 */
export const wasCancelled = (error) =>
  typeof error === "object" && error !== null && "name" in error && error.name === "AbortError";
