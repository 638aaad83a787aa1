/** The match table: only the rows in sight are elements, so that 500 matches scroll like 5. */

import { attribute, button, element, inNextFrame, put, say } from "../ui/dom.js";
import { wishHere } from "../net/requests.js";
import { icon } from "../ui/icons.js";
import { between, filtered, FILTERS, inSight, rowsOf, sorted } from "./match_rows.js";
import { notice } from "../ui/notices.js";
import { counted, fixed, NONE, short } from "../ui/numbers.js";
import { matchColour, store } from "../net/store.js";
import { view } from "../state/view.js";
import { nextThing } from "../state/progress.js";

const COLUMNS = [
  { by: "on", label: "on", said: "Counts or not", sortable: true },
  { by: "number", label: "match", said: "Number and colour" },
  { by: "kind", label: "kind", said: "Point or line" },
  { by: "origin", label: "origin", said: "Who put it there" },
  { by: "samples", label: "samples", said: "Samples with a range, of those along the line", figures: true },
  { by: "px", label: "px", said: "Residual in the photograph, pixels", figures: true },
  { by: "mm", label: "mm", said: "Residual in range, millimetres", figures: true },
  { by: "depth_m", label: "depth m", said: "Laser minus stereo depth, metres", figures: true },
  { by: "influence", label: "influence", said: "How far the picture would move without it, pixels", figures: true },
  { by: "weight", label: "weight", said: "Its weight in the solution", figures: true },
];
const FAST = 10;

/** One row's elements, made once for a match and then only refreshed. */
class RowElements {
  constructor(id) {
    this.id = id;
    this.on = element("input", { type: "checkbox", tabIndex: -1 });
    this.swatch = element("span", { class: "swatch", "aria-hidden": "true" });
    this.number = element("span", {});
    this.mark = element("span", { class: "mark" });
    this.cells = Object.fromEntries(
      ["kind", "origin", "samples", "px", "mm", "depth_m", "influence"].map(
        (name) => [name, element("div", { class: `cell col-${name}` })],
      ),
    );
    for (const name of ["samples", "px", "mm", "depth_m", "influence"]) this.cells[name].classList.add("figures");
    this.weight = element(
      "input",
      { class: "weight", inputMode: "decimal", tabIndex: -1, title: "Weight: Enter sets it, Esc leaves it" },
    );
    this.row = element(
      "div",
      { class: "row-line", role: "row", id: `match-${id}` },
      element("div", { class: "cell col-on" }, this.on),
      element("div", { class: "cell col-number" }, this.swatch, this.number, this.mark),
      ...Object.values(this.cells),
      element("div", { class: "cell col-weight figures" }, this.weight),
    );
    for (const cell of this.row.children) cell.setAttribute("role", "gridcell");
    this.row.dataset.pick = id;
  }

  show(row, { selected, hovered, cursor }, index, top) {
    this.value = row;
    const line = this.row;
    line.classList.toggle("off", !row.on);
    line.classList.toggle("rejected", row.on && row.inlier === false);
    line.classList.toggle("hovered", hovered);
    line.classList.toggle("cursor", cursor);
    attribute(line, "aria-selected", String(selected));
    attribute(line, "aria-rowindex", index + 2);
    line.style.setProperty("transform", `translateY(${top}px)`);
    this.swatch.style.setProperty("--colour", `var(${matchColour(row.number)})`);
    this.on.checked = row.on;
    attribute(this.on, "aria-label", `Match ${row.number} counts`);
    say(this.number, String(row.number));
    const mark = !row.on ? "off" : row.inlier === false ? "rejected" : "";
    if (this.mark.dataset.mark !== mark) {
      this.mark.dataset.mark = mark;
      put(
        this.mark,
        mark === "rejected" ? icon("cross") : null,
        mark ? element("span", { class: mark === "off" ? "told" : "" }, mark) : null,
      );
    }
    say(this.cells.kind, row.kind);
    say(this.cells.origin, row.origin);
    say(
      this.cells.samples,
      row.used === null ? NONE : row.used === row.sampled ? String(row.used) : `${row.used}/${row.sampled}`,
    );
    this.cells.samples.classList.toggle("short", row.used !== null && row.used < row.sampled);
    say(this.cells.px, fixed(row.px, 2));
    say(this.cells.mm, fixed(row.mm, row.mm !== null && row.mm < 10 ? 1 : 0));
    say(this.cells.depth_m, fixed(row.depth_m, 3));
    say(this.cells.influence, short(row.influence));
    if (document.activeElement !== this.weight) this.weight.value = fixed(
      row.weight,
      row.weight % 1 && row.weight < 10 ? 2 : 1,
    );
    attribute(this.weight, "aria-label", `Weight of match ${row.number}`);
  }
}

/** @returns {HTMLElement} the whole column: head, chips, table */
export const mountMatchTable = () => {
  const title = element("h2", {}, "Matches");
  const counts = element("span", { class: "counts" });
  const chips = FILTERS.map(({ name }) => {
    const made = element("button", { type: "button", class: "chip small filter" });
    made.addEventListener("click", () => {
      const { filter } = view.get();
      view.set({ filter: filter.includes(name) ? filter.filter((each) => each !== name) : [...filter, name] });
    });
    return made;
  });
  const remove = button({ label: "Remove", kind: "small", act: () => removeSelected() });
  const switcher = button({ label: "Off", kind: "small", act: () => switchSelected() });
  const heads = COLUMNS.map(({ by, label, said, figures }) => {
    const made = element(
      "button",
      { type: "button", class: `sorter ${figures ? "figures" : ""}`, title: `${said}; click to sort`, tabIndex: 0 },
      element("span", {}, label),
    );
    made.addEventListener("click", () => {
      const { sort } = view.get();
      const worstFirst = Boolean(figures);
      view.set({ sort: { by, descending: sort.by === by ? !sort.descending : worstFirst } });
    });
    return element("div", { class: `cell head col-${by} ${figures ? "figures" : ""}`, role: "columnheader" }, made);
  });
  const headRow = element("div", { class: "row-line heads", role: "row" }, ...heads);
  const spacer = element("div", { class: "rows", role: "rowgroup" });
  const scroller = element("div", { class: "grid-scroll" }, headRow, spacer);
  const grid = element(
    "div",
    { class: "match-grid", role: "grid", tabIndex: 0, "aria-label": "Matches", "aria-multiselectable": "true" },
    scroller,
  );
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

  let rows = [];
  let all = [];
  let cursor = null; // the row that keys move
  let anchor = null; // where a range begins
  const elements = new Map();

  const chosen = () => [...view.get().selected].filter((id) => all.some((row) => row.id === id));
  const rowHeight = () => headRow.offsetHeight || 24;

  const draw = inNextFrame(() => {
    const { selected, hovered } = view.get();
    const height = rowHeight();
    spacer.style.setProperty("height", `${rows.length * height}px`);
    const [first, end] = inSight({
      top: scroller.scrollTop,
      height: scroller.clientHeight,
      row: height,
      count: rows.length,
    });
    const keep = new Set();
    for (let index = first; index < end; index += 1) {
      const row = rows[index];
      keep.add(row.id);
      if (!elements.has(row.id)) elements.set(row.id, new RowElements(row.id));
      const made = elements.get(row.id);
      made.show(
        row,
        { selected: selected.has(row.id), hovered: hovered === row.id, cursor: cursor === row.id },
        index,
        index * height,
      );
      if (!made.row.isConnected) spacer.append(made.row);
    }
    for (const [id, made] of elements) {
      if (keep.has(id) || made.row.contains(document.activeElement)) continue;
      made.row.remove();
      if (!all.some((row) => row.id === id)) elements.delete(id);
    }
    attribute(grid, "aria-activedescendant", cursor && keep.has(cursor) ? `match-${cursor}` : null);
    attribute(grid, "aria-rowcount", rows.length + 1);
    const ids = chosen();
    remove.disabled = switcher.disabled = ids.length === 0;
    remove.title = `Remove ${counted(ids.length, "match", "matches")} (Delete)`;
    const off = ids.every((id) => !all.find((row) => row.id === id).on);
    say(switcher.querySelector("span"), off && ids.length ? "On" : "Off");
    switcher.title = `Switch ${counted(ids.length, "match", "matches")} ${off ? "on" : "off"} (Space)`;
  });

  const read = () => {
    const { filter, sort } = view.get();
    all = rowsOf(store.picksOf(), store.judgedOf());
    rows = sorted(filtered(all, filter), sort);
    FILTERS.forEach(({ name, one = name, keeps }, index) => {
      const count = all.filter(keeps).length;
      const made = chips[index];
      say(made, counted(count, one, name));
      made.hidden = (count === 0 || count === all.length) && !filter.includes(name); // it would tell nothing apart
      made.setAttribute("aria-pressed", String(filter.includes(name)));
      made.title = filter.includes(name) ? "Show all again" : `Show only: ${name}`;
    });
    const on = all.filter((row) => row.on).length;
    say(counts, all.length ? `${on} of ${all.length} on` : "");
    COLUMNS.forEach(({ by }, index) => {
      attribute(heads[index], "aria-sort", sort.by === by ? (sort.descending ? "descending" : "ascending") : null);
    });
    grid.hidden = all.length === 0;
    empty.hidden = all.length > 0 && rows.length > 0;
    say(
      empty,
      all.length ? (rows.length ? "" : "No match is of this kind; click the chip again to see all.") : nextThing({
        scan: store.get("scan"),
        photo: store.photo(),
        picks: [],
        poses: store.posesOf(),
      }),
    );
    draw();
  };

  const intoSight = (id) => {
    const index = rows.findIndex((row) => row.id === id);
    if (index < 0) return;
    const height = rowHeight();
    const room = scroller.clientHeight - height;
    if (index * height < scroller.scrollTop) scroller.scrollTop = index * height;
    else if ((index + 1) * height > scroller.scrollTop + room) scroller.scrollTop = (index + 1) * height - room;
  };

  const select = (ids, reveal = null) => view.set({ selected: new Set(ids), end: null, ...(reveal ? { reveal } : {}) });
  const pickRow = (id, { shift = false, more = false } = {}) => {
    const { selected } = view.get();
    cursor = id;
    if (shift && anchor) select(more ? [...selected, ...between(rows, anchor, id)] : between(rows, anchor, id));
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
    if (picks.length) wishHere("remove_picks", { picks });
  };
  const switchSelected = () => {
    const picks = chosen();
    if (picks.length) wishHere(
      "switch_picks",
      { picks, on: picks.every((id) => !all.find((row) => row.id === id).on) },
    );
  };
  const rowAt = (target) => target.closest?.("[data-pick]")?.dataset.pick ?? null;

  spacer.addEventListener("click", (event) => {
    const id = rowAt(event.target);
    if (!id || event.target.closest("input")) return;
    pickRow(id, { shift: event.shiftKey, more: event.ctrlKey || event.metaKey });
  });
  spacer.addEventListener(
    "mousedown",
    (event) => event.shiftKey && !event.target.closest("input") && event.preventDefault(),
  );
  spacer.addEventListener("change", (event) => {
    const id = rowAt(event.target);
    if (!id) return;
    if (event.target.type === "checkbox") {
      const { selected } = view.get();
      const picks = selected.has(id) && selected.size > 1 ? chosen() : [id];
      wishHere("switch_picks", { picks, on: event.target.checked });
      return;
    }
    const weight = Number(event.target.value.replace(",", "."));
    const made = elements.get(id);
    if (Number.isFinite(weight) && weight > 0) wishHere("set_pick", { pick: id, weight });
    else {
      notice(`The weight of match ${made.value.number} must be a number above zero; it stays what it was.`, "bad");
      event.target.value = String(made.value.weight);
    }
    event.target.blur();
    draw();
  });
  spacer.addEventListener("keydown", (event) => {
    if (!event.target.matches("input.weight")) return;
    event.stopPropagation();
    if (event.key === "Escape") event.target.value = String(elements.get(rowAt(event.target)).value.weight);
    if (event.key === "Escape" || event.key === "Enter") {
      event.preventDefault();
      event.target.blur();
      grid.focus({ preventScroll: true });
    }
  });
  spacer.addEventListener("focusin", (event) => event.target.matches("input.weight") && event.target.select());
  spacer.addEventListener("pointerover", (event) => view.set({ hovered: rowAt(event.target) }));
  spacer.addEventListener("pointerleave", () => view.set({ hovered: null }));
  scroller.addEventListener("scroll", draw, { passive: true });
  new ResizeObserver(draw).observe(scroller);

  const move = (by, shift) => {
    if (rows.length === 0) return;
    const at = rows.findIndex((row) => row.id === cursor);
    const next = rows[Math.max(0, Math.min(rows.length - 1, at < 0 ? 0 : at + by))].id;
    pickRow(next, { shift });
    intoSight(next);
  };
  const keys = {
    ArrowDown: (event) => move(1, event.shiftKey),
    ArrowUp: (event) => move(-1, event.shiftKey),
    PageDown: (event) => move(FAST, event.shiftKey),
    PageUp: (event) => move(-FAST, event.shiftKey),
    Home: (event) => move(-rows.length, event.shiftKey),
    End: (event) => move(rows.length, event.shiftKey),
    Delete: removeSelected,
    Backspace: removeSelected,
    " ": switchSelected,
    Enter: () => cursor && view.set({ reveal: cursor }),
    F2: () => cursor && elements.get(cursor)?.weight.focus(),
  };
  grid.addEventListener("keydown", (event) => {
    if (event.target.closest("input, button")) return;
    const everything = (event.ctrlKey || event.metaKey) && event.key === "a";
    if (!everything && (event.ctrlKey || event.metaKey || event.altKey || !keys[event.key])) return;
    event.preventDefault();
    event.stopPropagation();
    if (everything) select(rows.map(({ id }) => id));
    else keys[event.key](event);
  });

  store.watch(["picks:*", "judged:*", "shown", "scan", "photos", "poses:*"], read);
  view.on((state, changed) => {
    if (changed.has("filter") || changed.has("sort")) read();
    else if (changed.has("selected")) {
      const [only] = state.selected;
      if (state.selected.size === 1 && only !== cursor) {
        cursor = anchor = only;
        intoSight(only); // chosen in a picture
      }
      draw();
    } else if (changed.has("hovered")) draw();
  });
  read();
  return column;
};
