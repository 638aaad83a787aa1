/** Files on their way to the workbench. */

import { bytes } from "../ui/numbers.js";
import { store } from "./store.js";

const UNREACHED =
  "The file did not arrive: the connection was lost on the way; send it again when the status bar says " +
  "connected.";

const STRANGER = "The workbench no longer knows this page: open its address again, with the token.";

const tooLarge = (name, most) =>
  `${name} is larger than the ${bytes(most)} that are taken here: make it smaller, ` +
  (store.get("served") ? "or put it into the served folder." : "or have the workbench started on it or with a larger limit.");

const answerOf = (request) => {
  try {
    return JSON.parse(request.responseText);
  } catch {
    return {};
  }
};

const refusal = (request, name) => {
  const said = answerOf(request).error;
  if (said) return said.startsWith(name) ? said : `${name}: ${said}`;
  const { status } = request;
  if (status === 413) return tooLarge(name, store.get("limits")?.upload_bytes ?? 0);
  if (status === 401 || status === 403) return STRANGER;
  return `${name} was refused (status ${status}): try again, or look at what the workbench printed.`;
};

/**
 * Send a file.
 * @param {File} file
 * @param {{what: string, photo?: string | null, progress?: (share: number) => void}} as
 * @returns {{finished: Promise<string>, abort: () => void}} `finished` gives the id, or rejects with an Error in one
 *   sentence; after an abort its name is `AbortError`
 */
export const sendFile = (file, { what, photo = null, progress = () => {} }) => {
  const request = new XMLHttpRequest();
  const address = new URL("upload", document.baseURI);
  address.searchParams.set("what", what);
  if (photo) address.searchParams.set("photo", photo);
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
    request.addEventListener("error", () => reject(new Error(`${file.name}: ${UNREACHED}`)));
    request.addEventListener("abort", () => reject(new DOMException(`${file.name} was not sent.`, "AbortError")));
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
