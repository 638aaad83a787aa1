/**
 * The columns of the match table. This array drives the head, the cells, the sorting and the grid: to add a column, add
 * an entry here. A value that rows do not have yet is added in match_rows.js.
 */

import { matchColour } from "../../net/store.js";
import { element, setAttribute, setChildren, setText } from "../../ui/dom.js";
import { icon } from "../../ui/icons.js";
import { fixed, NONE, short } from "../../ui/numbers.js";

/**
 * @typedef {import("./match_rows.js").Row} Row
 * @typedef {object} Column
 * @property {string} id unique; also the name of its CSS class, `col-ID`
 * @property {string} label its head
 * @property {string} title tooltip of the head
 * @property {(row: Row) => number | string | null} value to sort by; null sorts last
 * @property {(row: Row) => string} [text] of a cell
 * @property {() => {content: Node[], show: (row: Row) => void}} [control] makes a cell of more than text, instead of
 *   `text`
 * @property {string} width a track of the CSS grid
 * @property {boolean} [figures] numbers: aligned right, and the largest first when sorted
 * @property {(row: Row) => boolean} [warns] whether the cell is shown as a warning
 * @property {"narrow" | "narrowest"} [hidden] in a table this narrow (css/table.css) the column is left out
 */

const WEIGHT_HINT = "Weight: Enter applies it, Esc cancels";

const switchCell = () => {
  const box = element("input", { type: "checkbox", tabIndex: -1 });
  const show = (/** @type {Row} */ row) => {
    box.checked = row.on;
    setAttribute(box, "aria-label", `Match ${row.number} enabled`);
  };
  return { content: [element("label", { class: "row-check" }, box)], show }; // the whole cell switches
};

const numberCell = () => {
  const swatch = element("span", { class: "swatch", "aria-hidden": "true" });
  const number = element("span", {});
  const mark = element("span", { class: "mark" });
  const show = (/** @type {Row} */ row) => {
    swatch.style.setProperty("--colour", `var(${matchColour(row.number)})`);
    setText(number, String(row.number));
    const said = [row.name, row.length].filter(Boolean).join(": ");
    if (number.title !== said) number.title = said;
    const state = !row.on ? "disabled" : row.inlier === false ? "outlier" : row.beyond ? "other length" : "";
    if (mark.dataset.mark === state) return;
    mark.dataset.mark = state;
    mark.title =
      state === "outlier" ? "Outlier: it does not agree with the shown pose" :
      state === "other length" ? "Its length differs from the scan's own range by more than the tolerance" : "";
    setChildren(
      mark,
      state === "outlier" ? icon("cross") : state === "other length" ? icon("warn") : null,
      state ? element("span", { class: "visually-hidden" }, state) : null,
    );
  };
  return { content: [swatch, number, mark], show };
};

const weightCell = () => {
  const input = element("input", { class: "weight", inputMode: "decimal", tabIndex: -1, title: WEIGHT_HINT });
  const show = (/** @type {Row} */ row) => {
    const decimals = row.weight % 1 && row.weight < 10 ? 2 : 1;
    if (document.activeElement !== input) input.value = fixed(row.weight, decimals);
    setAttribute(input, "aria-label", `Weight of match ${row.number}`);
  };
  return { content: [input], show };
};

/** A line without a straight edge under it is not lost: its ends are used as they were drawn. */
const samplesText = (/** @type {Row} */ { used, sampled }) =>
  used === null ? NONE : used === 0 ? "ends" : used === sampled ? String(used) : `${used}/${sampled}`;

/** @type {Column[]} */
export const COLUMNS = [
  {
    id: "on",
    label: "on",
    title: "Whether the match is enabled",
    value: (row) => (row.on ? 1 : 0),
    control: switchCell,
    width: "var(--column-on, 2.2rem)",
  },
  {
    id: "number",
    label: "match",
    title: "Number and colour",
    value: (row) => row.number,
    control: numberCell,
    width: "minmax(3.4rem, 1.05fr)",
  },
  {
    id: "kind",
    label: "kind",
    title: "Point or line",
    value: (row) => row.kind,
    text: (row) => row.kind,
    width: "minmax(2.6rem, 0.8fr)",
  },
  {
    id: "origin",
    label: "origin",
    title: "How the match was made",
    value: (row) => row.origin,
    text: (row) => row.origin,
    width: "minmax(4rem, 1.3fr)",
    hidden: "narrow",
  },
  {
    id: "samples",
    label: "samples",
    title: "Samples along the line that lie on one straight edge of the scan; ends: none, so that only the ends of the " +
      "line are used",
    value: (row) => row.used,
    text: samplesText,
    warns: (row) => row.used !== null && row.used < (row.sampled ?? 0) / 2,
    width: "minmax(0, 1fr)",
    figures: true,
    hidden: "narrowest",
  },
  {
    id: "px",
    label: "px",
    title: "Residual in the photograph, pixels",
    value: (row) => row.px,
    text: (row) => fixed(row.px, 2),
    width: "minmax(0, 1fr)",
    figures: true,
  },
  {
    id: "mm",
    label: "mm",
    title: "Range residual, millimetres",
    value: (row) => row.mm,
    text: (row) => fixed(row.mm, row.mm !== null && row.mm < 10 ? 1 : 0),
    width: "minmax(0, 1fr)",
    figures: true,
  },
  {
    id: "depth_m",
    label: "depth m",
    title: "Depth error, metres: laser minus stereo depth",
    value: (row) => (row.depth_m === null ? null : Math.abs(row.depth_m)), // -0.3 m is worse than 0.1 m
    text: (row) => fixed(row.depth_m, 3),
    width: "minmax(0, 1fr)",
    figures: true,
  },
  {
    id: "influence",
    label: "influence",
    title: "Influence: how far the projection shifts without this match, pixels",
    value: (row) => row.influence,
    text: (row) => short(row.influence),
    width: "minmax(0, 1.25fr)",
    figures: true,
    hidden: "narrowest",
  },
  {
    id: "weight",
    label: "weight",
    title: "Weight in the solution",
    value: (row) => row.weight,
    control: weightCell,
    width: "minmax(0, 1fr)",
    figures: true,
  },
];

/** @type {Record<string, (string | undefined)[]>} what is left out in a table of each width */
const HIDDEN = { wide: [], narrow: ["narrow"], narrowest: ["narrow", "narrowest"] };

/** @returns {Record<string, string>} CSS custom properties: the grid's tracks for each width of the table */
export const gridTracks = () =>
  Object.fromEntries(
    Object.entries(HIDDEN).map(([width, hidden]) => [
      `--columns-${width}`,
      COLUMNS.filter((column) => !hidden.includes(column.hidden)).map((column) => column.width).join(" "),
    ]),
  );

/** @param {Column} column @returns {string} CSS classes of its cells and head */
export const classOf = ({ id, figures, hidden }) =>
  ["cell", `col-${id}`, figures ? "figures" : "", hidden ? `hidden-${hidden}` : ""].filter(Boolean).join(" ");

/**
 * Make a cell.
 * @param {Column} column
 * @returns {{cell: HTMLElement, show: (row: Row) => void}}
 */
export const makeCell = (column) => {
  const { text, control, warns } = column;
  const cell = element("div", { class: classOf(column), role: "gridcell" });
  const parts = control ? control() : { content: [], show: (/** @type {Row} */ row) => setText(cell, text?.(row) ?? "") };
  cell.append(...parts.content);
  const show = (/** @type {Row} */ row) => {
    parts.show(row);
    if (warns) cell.classList.toggle("warns", warns(row));
  };
  return { cell, show };
};

/**
 * Sort without changing the given array; rows without a value come last in either direction, equals by number.
 * @param {Row[]} rows
 * @param {{by: string, descending: boolean}} sort `by` is a column's id; another name sorts by number
 * @returns {Row[]}
 */
export const sorted = (rows, { by, descending }) => {
  const value = COLUMNS.find(({ id }) => id === by)?.value ?? ((row) => row.number);
  const sign = descending ? -1 : 1;
  return [...rows].sort((a, b) => {
    const [left, right] = [value(a), value(b)];
    if (left === null || right === null) return left === right ? a.number - b.number : left === null ? 1 : -1;
    if (left !== right) return left < right ? -sign : sign;
    return a.number - b.number;
  });
};
