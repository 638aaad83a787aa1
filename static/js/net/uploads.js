/** Upload of files to the workbench. */

import { bytes } from "../ui/numbers.js";
import { store } from "./store.js";

const CONNECTION_LOST =
  "the connection was lost during the upload; send the file again when the status bar shows connected.";

const NOT_AUTHORISED = "The workbench no longer accepts this page: open its address again, with the token.";

/** @param {string} name @param {number} most bytes @returns {string} */
const tooLarge = (name, most) =>
  `${name} is larger than the ${bytes(most)} that the workbench accepts: reduce it, ` +
  (store.get("served") ? "or put it into the served folder." : "or start the workbench with the file, or with a larger limit.");

/** @param {XMLHttpRequest} request @returns {any} */
const answerOf = (request) => {
  try {
    return JSON.parse(request.responseText);
  } catch {
    return {};
  }
};

/** @param {XMLHttpRequest} request @param {string} name of the file @returns {string} */
const refusal = (request, name) => {
  const error = answerOf(request).error;
  if (error) return error.startsWith(name) ? error : `${name}: ${error}`;
  const { status } = request;
  if (status === 413) return tooLarge(name, store.get("limits")?.upload_bytes ?? 0);
  if (status === 401 || status === 403) return NOT_AUTHORISED;
  return `${name} was refused (status ${status}): try again, or see the output of the workbench.`;
};

/**
 * Upload a file.
 * @param {File} file
 * @param {{what: string, photo?: string | null, progress?: (share: number) => void}} options
 * @returns {{finished: Promise<string>, abort: () => void}} `finished` resolves to the id, or rejects with an Error
 *   whose message is one sentence; after `abort` its name is `AbortError`
 */
export const sendFile = (file, { what, photo = null, progress = () => {} }) => {
  const request = new XMLHttpRequest();
  const address = new URL("upload", document.baseURI);
  address.searchParams.set("what", what);
  if (photo) address.searchParams.set("photo", photo);
  address.searchParams.set("client", store.get("people")?.you ?? "");
  const finished = new Promise((resolve, reject) => {
    request.upload.addEventListener(
      "progress",
      ({ loaded, total, lengthComputable }) => lengthComputable && progress(total ? loaded / total : 1),
    );
    request.addEventListener("load", () => {
      const answer = answerOf(request);
      if (request.status === 200 && answer.ok) resolve(answer.id);
      else reject(new Error(refusal(request, file.name)));
    });
    request.addEventListener("error", () => reject(new Error(`${file.name}: ${CONNECTION_LOST}`)));
    request.addEventListener("abort", () => reject(new DOMException(`The upload of ${file.name} was cancelled.`, "AbortError")));
  });
  const most = store.get("limits")?.upload_bytes;
  if (most && file.size > most) {
    return { finished: Promise.reject(new Error(tooLarge(file.name, most))), abort: () => {} };
  }
  request.open("POST", address);
  request.setRequestHeader("X-File-Name", encodeURIComponent(file.name));
  request.setRequestHeader("Content-Type", "application/octet-stream");
  request.send(file);
  return { finished, abort: () => request.abort() };
};
