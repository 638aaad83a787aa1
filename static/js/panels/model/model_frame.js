/** viser's page in a frame: its address, its keys, its focus, and its failures. */

import { store } from "../../net/store.js";
import { whenPanesPainted } from "../../ui/first_pictures.js";

const UNREACHED = "The 3-D view cannot be reached: reload the page."; // the browser's error page is not accessible
const TYPING = "input, textarea, select, [contenteditable], [role=textbox]";

/**
 * Show that the focus is inside the frame, which CSS cannot detect.
 * @param {HTMLIFrameElement} frame
 * @param {Window} inner
 */
const showFocus = (frame, inner) => {
  inner.addEventListener("focus", () => frame.classList.add("focused"));
  inner.addEventListener("blur", () => frame.classList.remove("focused"));
};

/** Stops the devices of an acquisition: forwarded whatever has the focus. */
const STOP = "F8";

/**
 * Forward keys from the frame to the page, except while text is typed.
 * @param {HTMLIFrameElement} frame
 * @param {Window} inner
 */
const forwardKeys = (frame, inner) => {
  for (const kind of /** @type {const} */ (["keydown", "keyup"])) {
    inner.addEventListener(kind, (event) => {
      const { target } = event; // of the frame's own class
      const types = target !== null && "closest" in target && /** @type {Element} */ (target).closest(TYPING) !== null;
      if (event.key !== STOP && (event.defaultPrevented || types)) return;
      const { key, code, ctrlKey, shiftKey, altKey, metaKey, repeat } = event;
      const sent = new KeyboardEvent(
        kind,
        { key, code, ctrlKey, shiftKey, altKey, metaKey, repeat, bubbles: true, cancelable: true },
      );
      if (!frame.dispatchEvent(sent)) event.preventDefault();
    });
  }
};

/**
 * Open viser's page as soon as there is something to show, under this client's id.
 * @param {HTMLIFrameElement} frame
 * @param {{loaded: (got: number, total: number) => void, failed: (sentence: string) => void}} tell
 */
export const mountModelFrame = (frame, { loaded, failed }) => {
  const open = () => {
    const you = store.get("people")?.you;
    if (!you || !(store.get("scan") || store.get("acquisition")?.points)) return;
    const address = `viser/${encodeURIComponent(you)}/`;
    if (frame.getAttribute("src") !== address) frame.src = address;
  };
  addEventListener("message", ({ source, data }) => {
    if (source !== frame.contentWindow || !Array.isArray(data?.viewer)) return;
    const [got, total] = data.viewer;
    loaded(got, total);
  });
  frame.addEventListener("load", () => {
    try {
      const { contentDocument: shown } = frame;
      const inner = frame.contentWindow;
      if (!shown || !inner) return failed(UNREACHED);
      failed(shown.contentType === "text/plain" ? (shown.body.textContent ?? "").trim() : "");
      forwardKeys(frame, inner);
      return showFocus(frame, inner);
    } catch {
      return failed(UNREACHED);
    }
  });
  whenPanesPainted().then(() => {
    store.watch(["people", "scan", "acquisition"], open);
    open();
  });
};
