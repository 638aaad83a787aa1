/** The match table. Only visible rows are elements, so that 500 matches scroll as fast as 5. */

import { requestForPhoto } from "../../net/requests.js";
import { store } from "../../net/store.js";
import { progressNow } from "../../state/progress.js";
import { view } from "../../state/view.js";
import { button } from "../../ui/controls.js";
import { element, partOf, setAttribute, setText } from "../../ui/dom.js";
import { notice } from "../../ui/notices.js";
import { counted } from "../../ui/numbers.js";
import { inNextFrame } from "../../ui/throttle.js";
import { classOf, COLUMNS, gridTracks, makeCell, sorted } from "./match_columns.js";
import { filtered, FILTERS, idsBetween, rowsOf, visibleRange } from "./match_rows.js";

const PAGE_ROWS = 10;

/** @typedef {import("./match_rows.js").Row} Row */

/** The elements of one row: made once for a match, then only refreshed. */
class RowElements {
  /** @param {Row} row */
  constructor(row) {
    this.row = row;
    this.cells = COLUMNS.map(makeCell);
    this.element = element(
      "div",
      { class: "row-line", role: "row", id: `match-${row.id}` },
      ...this.cells.map(({ cell }) => cell),
    );
    this.element.dataset.pick = row.id;
    this.weight = partOf(this.element, "input.weight");
  }

  /**
   * @param {Row} row
   * @param {{selected: boolean, hovered: boolean, cursor: boolean}} state
   * @param {number} index
   * @param {number} top px
   */
  show(row, { selected, hovered, cursor }, index, top) {
    this.row = row;
    const line = this.element;
    line.classList.toggle("disabled", !row.on);
    line.classList.toggle("outlier", row.on && row.inlier === false);
    line.classList.toggle("hovered", hovered);
    line.classList.toggle("cursor", cursor);
    setAttribute(line, "aria-selected", String(selected));
    setAttribute(line, "aria-rowindex", index + 2);
    line.style.setProperty("transform", `translateY(${top}px)`);
    for (const { show } of this.cells) show(row);
  }
}

/** @returns {HTMLElement} the panel: head, filters, table */
export const mountMatchTable = () => {
  const title = element("h2", {}, "Matches");
  const counts = element("span", { class: "counts" });
  const chips = FILTERS.map(({ name }) => {
    const chip = element("button", { type: "button", class: "chip small filter" });
    chip.addEventListener("click", () => {
      const { filter } = view.get();
      view.set({ filter: filter.includes(name) ? filter.filter((each) => each !== name) : [...filter, name] });
    });
    return chip;
  });
  const remove = button({ label: "Remove", kind: "small edits", act: () => removeSelected() });
  const switcher = button({ label: "Disable", kind: "small edits", act: () => switchSelected() });
  const heads = COLUMNS.map((column) => {
    const { id, label, title: hint, figures } = column;
    const sorter = element(
      "button",
      { type: "button", class: "sorter", title: `${hint}; click to sort`, tabIndex: 0 },
      element("span", {}, label),
    );
    sorter.addEventListener("click", () => {
      const { sort } = view.get();
      view.set({ sort: { by: id, descending: sort.by === id ? !sort.descending : Boolean(figures) } });
    });
    return element("div", { class: `${classOf(column)} head`, role: "columnheader" }, sorter);
  });
  const headRow = element("div", { class: "row-line heads", role: "row" }, ...heads);
  const spacer = element("div", { class: "rows", role: "rowgroup" });
  const scroller = element("div", { class: "grid-scroll" }, headRow, spacer);
  const grid = element(
    "div",
    { class: "match-grid", role: "grid", tabIndex: 0, "aria-label": "Matches", "aria-multiselectable": "true" },
    scroller,
  );
  for (const [name, tracks] of Object.entries(gridTracks())) grid.style.setProperty(name, tracks);
  const empty = element("p", { class: "empty" });
  const column = element(
    "section",
    { class: "dock-part matches", "aria-label": "Matches" },
    element(
      "div",
      { class: "part-head" },
      title,
      element("div", { class: "chips", role: "group", "aria-label": "Show only" }, ...chips),
      counts,
      element("div", { class: "end" }, switcher, remove),
    ),
    grid,
    empty,
  );

  /** @type {Row[]} those that pass the filters, in the order of the table */
  let rows = [];
  /** @type {Row[]} */
  let all = [];
  /** @type {string | null} the row that the arrow keys start from */
  let cursor = null;
  /** @type {string | null} the first row of a range */
  let anchor = null;
  /** @type {Map<string, RowElements>} by the ids of the matches */
  const elements = new Map();

  const chosen = () => [...view.get().selected].filter((id) => all.some((row) => row.id === id));
  /** @returns {boolean} whether all of them are disabled */
  const areDisabled = (/** @type {string[]} */ ids) => ids.every((id) => !all.find((row) => row.id === id)?.on);
  const rowHeight = () => headRow.offsetHeight || 24;

  const draw = inNextFrame(() => {
    const { selected, hovered } = view.get();
    const height = rowHeight();
    spacer.style.setProperty("height", `${rows.length * height}px`);
    const [first, end] = visibleRange({
      top: scroller.scrollTop,
      height: scroller.clientHeight,
      row: height,
      count: rows.length,
    });
    const keep = new Set();
    for (let index = first; index < end; index += 1) {
      const row = rows[index];
      keep.add(row.id);
      const line = elements.get(row.id) ?? new RowElements(row);
      elements.set(row.id, line);
      line.show(
        row,
        { selected: selected.has(row.id), hovered: hovered === row.id, cursor: cursor === row.id },
        index,
        index * height,
      );
      if (!line.element.isConnected) spacer.append(line.element);
    }
    for (const [id, line] of elements) {
      if (keep.has(id) || line.element.contains(document.activeElement)) continue;
      line.element.remove();
      if (!all.some((row) => row.id === id)) elements.delete(id);
    }
    setAttribute(grid, "aria-activedescendant", cursor && keep.has(cursor) ? `match-${cursor}` : null);
    setAttribute(grid, "aria-rowcount", rows.length + 1);
    const ids = chosen();
    remove.disabled = switcher.disabled = ids.length === 0;
    remove.title = `Remove ${counted(ids.length, "match", "matches")} (Delete)`;
    const allDisabled = areDisabled(ids);
    setText(partOf(switcher, "span"), allDisabled && ids.length ? "Enable" : "Disable");
    switcher.title = `${allDisabled ? "Enable" : "Disable"} ${counted(ids.length, "match", "matches")} (Space)`;
  });

  const read = () => {
    const { filter, sort } = view.get();
    all = rowsOf(store.picksOf(), store.judgedOf());
    rows = sorted(filtered(all, filter), sort);
    FILTERS.forEach(({ name, one, many, keeps }, index) => {
      const count = all.filter(keeps).length;
      const chip = chips[index];
      setText(chip, counted(count, one, many));
      chip.hidden = (count === 0 || count === all.length) && !filter.includes(name); // it would select nothing or all
      chip.setAttribute("aria-pressed", String(filter.includes(name)));
      chip.title = filter.includes(name) ? "Show all matches" : `Show only ${many}`;
    });
    const enabled = all.filter((row) => row.on).length;
    setText(counts, all.length ? `${enabled} of ${all.length} enabled` : "");
    COLUMNS.forEach(({ id }, index) => {
      setAttribute(heads[index], "aria-sort", sort.by === id ? (sort.descending ? "descending" : "ascending") : null);
    });
    grid.hidden = all.length === 0;
    empty.hidden = all.length > 0 && rows.length > 0;
    setText(
      empty,
      all.length
        ? (rows.length ? "" : "No match passes the filters; click them again to show all.")
        : progressNow().next_action,
    );
    draw();
  };

  const scrollTo = (/** @type {string} */ id) => {
    const index = rows.findIndex((row) => row.id === id);
    if (index < 0) return;
    const height = rowHeight();
    const room = scroller.clientHeight - height;
    if (index * height < scroller.scrollTop) scroller.scrollTop = index * height;
    else if ((index + 1) * height > scroller.scrollTop + room) scroller.scrollTop = (index + 1) * height - room;
  };

  /** @param {Iterable<string>} ids @param {string | null} [offer] */
  const select = (ids, offer = null) => view.set({ selected: new Set(ids), end: null, ...(offer ? { offer } : {}) });
  const pickRow = (/** @type {string} */ id, { shift = false, more = false } = {}) => {
    const { selected } = view.get();
    cursor = id;
    if (shift && anchor) select(more ? [...selected, ...idsBetween(rows, anchor, id)] : idsBetween(rows, anchor, id));
    else if (more) {
      anchor = id;
      const next = new Set(selected);
      if (!next.delete(id)) next.add(id);
      select(next);
    } else {
      anchor = id;
      select([id], id);
    }
    draw();
  };
  const removeSelected = () => {
    const picks = chosen();
    if (picks.length) requestForPhoto("remove_picks", { picks });
  };
  const switchSelected = () => {
    const picks = chosen();
    if (picks.length) requestForPhoto("switch_picks", { picks, on: areDisabled(picks) });
  };
  /** @returns {boolean} whether an event is of a certain control */
  const isOn = (/** @type {Event} */ { target }, /** @type {string} */ selector) =>
    target instanceof Element && target.closest(selector) !== null;
  /** @returns {string | null} id of the match of its row */
  const rowOf = (/** @type {Event} */ { target }) =>
    (target instanceof Element ? target.closest("[data-pick]")?.getAttribute("data-pick") ?? null : null);
  /** @returns {HTMLInputElement | null} where a weight is typed */
  const weightOf = (/** @type {Event} */ { target }) =>
    (target instanceof HTMLInputElement && target.matches("input.weight") ? target : null);

  spacer.addEventListener("click", (event) => {
    const id = rowOf(event);
    if (!id || isOn(event, "input, .row-check")) return;
    pickRow(id, { shift: event.shiftKey, more: event.ctrlKey || event.metaKey });
  });
  spacer.addEventListener(
    "mousedown",
    (event) => event.shiftKey && !isOn(event, "input") && event.preventDefault(),
  );
  spacer.addEventListener("change", (event) => {
    const id = rowOf(event);
    const line = id && elements.get(id);
    const { target } = event;
    if (!line || !(target instanceof HTMLInputElement)) return;
    if (target.type === "checkbox") {
      const { selected } = view.get();
      const picks = selected.has(id) && selected.size > 1 ? chosen() : [id];
      requestForPhoto("switch_picks", { picks, on: target.checked });
      return;
    }
    const weight = Number(target.value.replace(",", "."));
    if (Number.isFinite(weight) && weight > 0) requestForPhoto("set_pick", { pick: id, weight });
    else {
      notice(`The weight of match ${line.row.number} must be a number above zero; it was not changed.`, "bad");
      target.value = String(line.row.weight);
    }
    target.blur();
    draw();
  });
  spacer.addEventListener("keydown", (event) => {
    const input = weightOf(event);
    if (!input) return;
    event.stopPropagation();
    if (event.key === "Escape") input.value = String(elements.get(rowOf(event) ?? "")?.row.weight ?? "");
    if (event.key === "Escape" || event.key === "Enter") {
      event.preventDefault();
      input.blur();
      grid.focus({ preventScroll: true });
    }
  });
  spacer.addEventListener("focusin", (event) => weightOf(event)?.select());
  spacer.addEventListener("pointerover", (event) => view.set({ hovered: rowOf(event) }));
  spacer.addEventListener("pointerleave", () => view.set({ hovered: null }));
  scroller.addEventListener("scroll", draw, { passive: true });
  new ResizeObserver(draw).observe(scroller);

  const move = (/** @type {number} */ by, /** @type {boolean} */ shift) => {
    if (rows.length === 0) return;
    const at = rows.findIndex((row) => row.id === cursor);
    const next = rows[Math.max(0, Math.min(rows.length - 1, at < 0 ? 0 : at + by))].id;
    pickRow(next, { shift });
    scrollTo(next);
  };
  /** @type {Record<string, (event: KeyboardEvent) => void>} */
  const keys = {
    ArrowDown: (event) => move(1, event.shiftKey),
    ArrowUp: (event) => move(-1, event.shiftKey),
    PageDown: (event) => move(PAGE_ROWS, event.shiftKey),
    PageUp: (event) => move(-PAGE_ROWS, event.shiftKey),
    Home: (event) => move(-rows.length, event.shiftKey),
    End: (event) => move(rows.length, event.shiftKey),
    Delete: removeSelected,
    Backspace: removeSelected,
    " ": switchSelected,
    Enter: () => view.set({ reveal: cursor }),
    F2: () => elements.get(cursor ?? "")?.weight.focus(),
  };
  grid.addEventListener("keydown", (event) => {
    if (isOn(event, "input, button")) return;
    const everything = (event.ctrlKey || event.metaKey) && event.key === "a";
    if (!everything && (event.ctrlKey || event.metaKey || event.altKey || !keys[event.key])) return;
    event.preventDefault();
    event.stopPropagation();
    if (everything) select(rows.map(({ id }) => id));
    else keys[event.key](event);
  });

  store.watch(["picks:*", "judged:*", "shown", "poses:*", "progress", "progress:*"], read);
  view.on((state, changed) => {
    if (changed.has("filter") || changed.has("sort")) read();
    else if (changed.has("selected")) {
      const [only] = state.selected;
      if (state.selected.size === 1 && only !== cursor) {
        cursor = anchor = only;
        scrollTo(only); // selected in a picture
      }
      draw();
    } else if (changed.has("hovered")) draw();
  });
  read();
  return column;
};
