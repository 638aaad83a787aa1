/** The jobs of a batch: what failed first, to be filtered and searched; each opens as a project. */

import { button, press } from "../../ui/controls.js";
import { element, newId, partOf, setChildren, setText } from "../../ui/dom.js";
import { icon } from "../../ui/icons.js";
import { counted } from "../../ui/numbers.js";

/**
 * @typedef {import("../../net/requests.js").Commands} Commands
 * @typedef {NonNullable<Commands["list_jobs"]["outcome"]>} Outcome
 * @typedef {{id: string, outcome: Outcome, kind: string, sigma: string, verdict: string, reason: string, picture: boolean,
 *   project: boolean}} BatchJob
 * @typedef {{name: string, runs: boolean, matching: number, counts: Record<Outcome, number>, jobs: BatchJob[]}} Listed the
 *   answer to `list_jobs`
 */

/** @type {Record<Outcome, {sign: string, level: string}>} */
const OUTCOMES = {
  failed: { sign: "bad", level: "bad" },
  refused: { sign: "warn", level: "warn" },
  waiting: { sign: "dot", level: "none" },
  accepted: { sign: "tick", level: "ok" },
};
/** @type {Record<string, string>} */
const KINDS = { pair: "", photos: "photographs of a scan", survey: "survey" };
const NAMES = /** @type {Outcome[]} */ (Object.keys(OUTCOMES));
const TYPED_MS = 250;
const AGAIN_MS = 5000;

/** @param {BatchJob} job @param {(job: string) => void} open */
const row = (job, open) => {
  const { sign, level } = OUTCOMES[job.outcome];
  const about = [KINDS[job.kind], job.sigma].filter(Boolean).join(" · ");
  return element(
    "li",
    {},
    element(
      "button",
      { type: "button", class: "job-row", title: [job.verdict, job.reason].filter(Boolean).join("\n"), on: { click: () => open(job.id) } },
      job.picture
        ? element("img", { class: "photo-thumbnail", src: `picture/job/${encodeURIComponent(job.id)}`, alt: "", loading: "lazy" })
        : element("span", { class: "photo-thumbnail" }),
      element("span", { class: "job-name clip" }, job.id, job.project ? " · opened" : ""),
      element("span", { class: `job-outcome ${level}` }, icon(sign), " ", job.outcome),
      element("span", { class: "dim clip" }, job.outcome === "accepted" ? job.verdict : job.reason || job.verdict),
      element("span", { class: "dim figures job-about" }, about),
    ),
  );
};

/**
 * @param {{ask: <Name extends keyof Commands>(name: Name, fields: Commands[Name]) => Promise<any>, open: (job: string) => void}} options
 * @returns {{part: HTMLElement, refresh: () => Promise<void>}} the list, and what fetches it anew
 */
export const batchList = ({ ask, open }) => {
  /** @type {Outcome | null} */
  let outcome = null;
  let timer = 0;
  /** @type {Map<string, HTMLElement>} by the jobs' ids */
  let rows = new Map();
  const heading = element("h3");
  const list = element("ul", { class: "job-list", "aria-label": "Jobs of the batch" });
  const shown = element("p", { class: "dim", role: "status" });
  const words = element("input", { id: newId("field"), type: "search", placeholder: "Name or reason", autocomplete: "off", maxLength: 200 });
  const filters = NAMES.map((each) => {
    const filter = button({ label: each, kind: "small", act: () => {
      outcome = outcome === each ? null : each;
      refresh();
    } });
    press(filter, false);
    return filter;
  });
  const part = element(
    "section",
    { class: "batch" },
    heading,
    element("div", { class: "row batch-tools" }, ...filters, element("label", { class: "end", for: words.id }, "Search"), words),
    list,
    shown,
  );

  const show = (/** @type {Listed} */ found) => {
    const total = Object.values(found.counts).reduce((sum, count) => sum + count, 0);
    setText(heading, `Batch ${found.name}: ${counted(total, "job")}${found.runs ? ", not finished" : ""}`);
    NAMES.forEach((each, at) => {
      setText(partOf(filters[at], "span"), `${found.counts[each]} ${each}`);
      filters[at].hidden = !found.counts[each] && outcome !== each;
      press(filters[at], outcome === each);
    });
    const focused = [...rows].find(([, each]) => each.contains(document.activeElement))?.[0];
    rows = new Map(found.jobs.map((job) => [job.id, row(job, open)]));
    setChildren(list, ...rows.values());
    if (focused) rows.get(focused)?.querySelector("button")?.focus();
    const more = found.matching - found.jobs.length;
    setText(shown, found.matching === 0 ? "No job matches." : more > 0 ? `and ${more} more: search for a name or a reason` : "");
  };
  const refresh = async () => {
    clearTimeout(timer);
    const found = await ask("list_jobs", { outcome, words: words.value.trim() });
    if (!found) return;
    show(found);
    if (found.runs) timer = setTimeout(() => part.isConnected && part.checkVisibility() && refresh(), AGAIN_MS);
  };
  words.addEventListener("input", () => {
    clearTimeout(timer);
    timer = setTimeout(refresh, TYPED_MS);
  });
  return { part, refresh };
};
