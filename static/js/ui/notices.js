/** Notices at the lower right: what is only told goes by itself, what went wrong stays until it is put away. */

import { button, element } from "./dom.js";
import { icon } from "./icons.js";

const SECONDS = { info: 6, warn: 12 };
const MOST = 5;
const SIGNS = { info: "info", warn: "warn", bad: "bad" };
const WORDS = { info: "Note", warn: "Warning", bad: "Not done" };

/** One region for each urgency: it must stand in the page before anything is said in it. */
const polite = element("div", { class: "notice-list", role: "status", "aria-live": "polite" });
const urgent = element("div", { class: "notice-list", role: "alert", "aria-live": "assertive" });

/** @returns {HTMLElement} where notices appear */
export const noticeArea = () => element("div", { class: "notices", "aria-label": "Notices" }, urgent, polite);

/**
 * Tell something.
 * @param {string} text one or more sentences
 * @param {"info" | "warn" | "bad"} [level]
 * @param {{label: string, act: () => void}} [offer] a button beside it
 */
export const notice = (text, level = "info", offer) => {
  const kind = SIGNS[level] ? level : "info";
  const list = kind === "bad" ? urgent : polite;
  for (const old of list.children) if (old.dataset.text === text) old.remove();
  const shown = element("div", { class: `notice ${kind}` });
  shown.dataset.text = text;
  const away = () => shown.remove();
  shown.append(
    icon(SIGNS[kind]),
    element("div", { class: "notice-text" }, element("span", { class: "told" }, `${WORDS[kind]}: `), text),
    ...(offer ? [button({ label: offer.label, kind: "small", act: () => (offer.act(), away()) })] : []),
    button({ label: "Put this notice away", icon: "close", kind: "plain small", bare: true, act: away }),
  );
  list.append(shown);
  while (list.children.length > MOST) list.firstElementChild.remove();
  if (!SECONDS[kind]) return;
  let timer = setTimeout(away, 1000 * SECONDS[kind]);
  shown.addEventListener("pointerenter", () => clearTimeout(timer));
  shown.addEventListener("pointerleave", () => {
    timer = setTimeout(away, 1000 * SECONDS[kind]);
  });
};
