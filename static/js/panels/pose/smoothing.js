/** Smoothing of ranges by an accepted pose: previewed, told apart at spikes and depth edges, applied or discarded. */

import { request, requestForPhoto } from "../../net/requests.js";
import { store } from "../../net/store.js";
import { isMeant, newRanges, previewNow } from "../../state/smoothing.js";
import { view } from "../../state/view.js";
import { button, press, tickBox } from "../../ui/controls.js";
import { element, setChildren, setText } from "../../ui/dom.js";
import { icon } from "../../ui/icons.js";
import { counted, fixed, typeset } from "../../ui/numbers.js";

/** @typedef {import("../../state/smoothing.js").NewRange} NewRange */

/** @type {["before" | "after" | "difference", string, string][]} */
const SHOWN = [
  ["before", "Before", "Show the returns where they are"],
  ["after", "After", "Show the returns where they would be"],
  ["difference", "Difference", "Show arrows from where the returns are to where they would be"],
];
const NEXT = "Draw points on spikes that you see, in the scan and in the photograph, solve, and preview again.";

const signed = (/** @type {number} */ value) => typeset(value > 0 ? `+${fixed(value, 3)}` : fixed(value, 3));

const headOf = () =>
  element("tr", {}, ...["At", "Before, m", "After, m", "Change, m", "1 σ, m"].map((name) => element("th", { scope: "col" }, name)));

const rowOf = (/** @type {NewRange} */ one) => {
  const [row, column] = one.id.split(".");
  const show = () => {
    const isShown = previewNow()?.photo === store.shown();
    view.set({ smoothed: one.id, reveal_place: isShown ? { ray: one.ray, uv: one.uv } : null });
  };
  return element(
    "tr",
    { class: `smoothed-range ${one.edge ? "edge" : "spike"}`, "data-range": one.id },
    element(
      "th",
      { scope: "row" },
      button({
        label: `Show the range in row ${row}, column ${column}`,
        text: one.edge ? "Depth edge" : "Spike",
        kind: "small plain",
        title: `Row ${row}, column ${column} of the scan`,
        act: show,
      }),
    ),
    ...[fixed(one.before_m, 3), fixed(one.after_m, 3), signed(one.after_m - one.before_m), fixed(one.sigma_m, 3)].map((text) =>
      element("td", { class: "figures" }, text),
    ),
  );
};

/** @returns {{opener: HTMLElement, section: HTMLElement}} the button that begins a preview, and what it opens */
export const mountSmoothing = () => {
  const opener = button({
    label: "Smooth ranges…",
    kind: "small edits",
    title: "Preview which spikes of the scan this pose contradicts, and what would replace them",
    act: () => requestForPhoto("preview_smoothing"),
  });
  const shows = SHOWN.map(([show, label, title]) =>
    button({ label, title, kind: "small", act: () => request("preview_smoothing", { photo: previewNow()?.photo ?? "", show }) }),
  );
  const edges = tickBox({ label: "At depth edges, too", changed: (on) => view.set({ smooth_edges: on }) });
  const again = button({ label: "Preview again", kind: "small edits", act: () => requestForPhoto("preview_smoothing") });
  const apply = button({
    label: "Apply",
    kind: "small primary edits",
    act: () => {
      const preview = previewNow();
      if (preview) request("apply_smoothing", { photo: preview.photo, rev: preview.rev, edges: view.get().smooth_edges });
    },
  });
  const discard = button({ label: "Discard", kind: "small", title: "End the preview; nothing was changed", act: () => request("discard_smoothing") });
  const restore = button({
    label: "Restore the measured ranges",
    text: "Restore",
    kind: "small edits",
    title: "Restore all ranges of the scan as they were measured",
    act: () => request("restore_ranges", { station: store.get("smoothing")?.station ?? "" }),
  });
  const applied = element("p", { class: "smoothing-applied" });
  const said = element("p", { role: "status" });
  const rows = element("tbody");
  const table = element(
    "div",
    { class: "smoothed-ranges", tabindex: "0", role: "region", "aria-label": "Ranges that would be replaced" },
    element("table", {}, element("thead", {}, headOf()), rows),
  );
  const showing = element("div", { class: "smoothing-show", role: "group", "aria-label": "Shown in the model" }, ...shows);
  const choices = element("div", { class: "smoothing-act" }, showing, edges.row);
  const decisions = element("div", { class: "smoothing-act" }, again, discard, apply);
  const preview = element("div", { class: "smoothing-preview" }, said, decisions, choices, table);
  const section = element("section", { class: "smoothing", "aria-label": "Smoothed ranges" }, applied, preview);

  const mark = () => {
    const { smoothed } = view.get();
    for (const row of rows.children) {
      row.classList.toggle("chosen", row.getAttribute("data-range") === smoothed);
      row.classList.toggle("left-out", row.classList.contains("edge") && !view.get().smooth_edges);
    }
  };

  const summaryOf = (/** @type {import("../../state/smoothing.js").Preview} */ shown) => {
    const ranges = newRanges();
    const spikes = ranges.filter(({ edge }) => !edge).length;
    if (shown.stale) return shown.stale;
    if (shown.nothing) return `Nothing would be replaced: ${shown.nothing}. ${NEXT}`;
    const meant = ranges.filter(isMeant).length;
    const places = `${counted(spikes, "spike")}, ${counted(ranges.length - spikes, "place")} at depth edges`;
    return `${counted(meant, "range")} would be replaced by stereo with ${shown.name}. Found: ${places}.`;
  };

  /** @type {NewRange[] | null} */
  let drawn = null;
  const show = () => {
    const state = store.get("smoothing");
    const shown = previewNow();
    const ranges = newRanges();
    const pose = store.photo();
    opener.disabled = pose?.state !== "accepted" || store.readOnly || Boolean(shown && !shown.stale);
    section.hidden = !shown && !state?.replaced;
    applied.hidden = !state?.replaced;
    setChildren(applied, icon("info"), " ", state?.sentence ?? "", " ", restore);
    preview.hidden = !shown;
    if (!shown) return;
    setText(said, summaryOf(shown));
    shows.forEach((each, k) => press(each, SHOWN[k][0] === shown.show));
    showing.hidden = table.hidden = ranges.length === 0;
    edges.row.hidden = !ranges.some(({ edge }) => edge);
    edges.show(view.get().smooth_edges);
    again.hidden = !shown.stale;
    apply.hidden = ranges.length === 0;
    const meant = ranges.filter(isMeant).length;
    apply.disabled = meant === 0 || store.readOnly;
    setText(apply.querySelector("span") ?? apply, meant ? `Apply to ${counted(meant, "range")}` : "Apply");
    if (drawn !== ranges) {
      drawn = ranges;
      setChildren(rows, ...ranges.map(rowOf));
    }
    mark();
  };
  store.watch(["smoothing", "photos", "shown", "people"], show);
  view.on((_, changed) => {
    if (changed.has("smooth_edges")) show();
    if (changed.has("smoothed")) mark();
  });
  show();
  return { opener, section };
};
