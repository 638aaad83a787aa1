/** Notices at the lower right: information and warnings disappear by themselves, errors stay until they are closed. */

import { button } from "./controls.js";
import { element } from "./dom.js";
import { icon } from "./icons.js";

/** @type {Record<string, number>} those that are not here stay */
const SECONDS = { info: 6, warn: 12 };
const MOST = 5;
const ICONS = { info: "info", warn: "warn", bad: "bad" };
const LABELS = { info: "Note", warn: "Warning", bad: "Error" };

/** One live region for each urgency; screen readers announce only what is added to an existing region. */
const polite = element("div", { class: "notice-list", role: "status", "aria-live": "polite" });
const urgent = element("div", { class: "notice-list", role: "alert", "aria-live": "assertive" });

/** @returns {HTMLElement} the area in which notices appear */
export const noticeArea = () => element("div", { class: "notices", role: "region", "aria-label": "Notices" }, urgent, polite);

/** @type {Map<HTMLElement, {about: () => unknown, value: string}>} what the shown notices speak of, by their elements */
const subjects = new Map();

/** Remove the notices whose subject has changed, or that are gone anyway. */
export const dropOutdated = () => {
  for (const [shown, { about, value }] of subjects) {
    if (shown.isConnected && JSON.stringify(about()) === value) continue;
    shown.remove();
    subjects.delete(shown);
  }
};

/**
 * Show a notice.
 * @param {string} text one or more sentences
 * @param {"info" | "warn" | "bad"} [level]
 * @param {{label: string, act: () => void}} [offer] a button beside the text
 * @param {() => unknown} [about] what it speaks of: the notice disappears once this has another value
 */
export const notice = (text, level = "info", offer, about) => {
  const kind = ICONS[level] ? level : "info";
  const list = kind === "bad" ? urgent : polite;
  for (const old of list.querySelectorAll("[data-text]")) if (old.getAttribute("data-text") === text) old.remove();
  const shown = element("div", { class: `notice ${kind}` });
  shown.dataset.text = text;
  const close = () => shown.remove();
  shown.append(
    icon(ICONS[kind]),
    element("div", { class: "notice-text" }, element("span", { class: "visually-hidden" }, `${LABELS[kind]}: `), text),
    ...(offer ? [button({ label: offer.label, kind: "small", act: () => (offer.act(), close()) })] : []),
    button({ label: "Close this notice", icon: "close", kind: "plain small", bare: true, act: close }),
  );
  list.append(shown);
  if (about) subjects.set(shown, { about, value: JSON.stringify(about()) });
  while (list.children.length > MOST) list.firstElementChild?.remove();
  if (!SECONDS[kind]) return;
  let timer = setTimeout(close, 1000 * SECONDS[kind]);
  shown.addEventListener("pointerenter", () => clearTimeout(timer));
  shown.addEventListener("pointerleave", () => {
    timer = setTimeout(close, 1000 * SECONDS[kind]);
  });
};
