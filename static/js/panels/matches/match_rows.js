/** The rows of the match table: picks joined with their residuals, filters, visible range, selection. No DOM here. */

/**
 * @typedef {{id: string, number: number, kind: string, origin: string, on: boolean, weight: number, sampled: number |
 *   null, used: number | null, px: number | null, mm: number | null, depth_m: number | null, influence: number | null,
 *   inlier: boolean | null, agrees: boolean | null, judged: boolean, name: string, length: string, beyond: boolean}} Row
 */

const MINUS = "\u2212";
const DRAWN = new Set(["manual", "file"]);

/** @typedef {{name: string, one: string, many: string, group: string, keeps: (row: Row) => boolean}} Filter */

/** @type {Filter[]} those of one group are combined by or, the groups by and */
export const FILTERS = [
  { name: "lines", one: "line", many: "lines", group: "kind", keeps: (row) => row.kind === "line" },
  { name: "points", one: "point", many: "points", group: "kind", keeps: (row) => row.kind === "point" },
  { name: "found", one: "detected", many: "detected", group: "state", keeps: (row) => !DRAWN.has(row.origin) },
  { name: "off", one: "disabled", many: "disabled", group: "state", keeps: (row) => !row.on },
  { name: "rejected", one: "outlier", many: "outliers", group: "state", keeps: (row) => row.on && row.inlier === false },
];

/**
 * @typedef {import("../../protocol.d.ts").Judged} Judged
 */

/** @param {Judged["lengths"][string] | undefined} found @returns {string} */
const lengthOf = (found) => {
  if (!found) return "";
  const own = `length ${found.length_m.toFixed(3)} m`;
  if (found.scan_range_m === null || found.difference_m === null) return `${own}; the scan has none there (${found.state})`;
  const more = found.difference_m < 0 ? MINUS : "+";
  return `${own}, the scan ${found.scan_range_m.toFixed(3)} m (${more}${Math.abs(found.difference_m).toFixed(3)} m)`;
};

/**
 * @param {import("../../net/store.js").Pick[]} picks
 * @param {Judged | null} judged slice `judged:pID`, or null
 * @returns {Row[]}
 */
export const rowsOf = (picks, judged) =>
  picks.map((pick) => {
    const residuals = judged?.by_pick?.[pick.id];
    const line = judged?.lines?.[pick.id];
    return {
      id: pick.id,
      number: pick.number,
      kind: pick.kind,
      origin: pick.origin,
      on: pick.on,
      weight: pick.weight,
      sampled: line?.sampled ?? null,
      used: line?.used ?? null,
      px: residuals?.px ?? null,
      mm: residuals?.mm ?? null,
      depth_m: residuals?.depth_m ?? null,
      influence: residuals?.influence ?? null,
      inlier: residuals?.inlier ?? null,
      agrees: residuals?.agrees ?? null,
      judged: residuals !== undefined,
      name: pick.name ?? "",
      length: lengthOf(judged?.lengths?.[pick.id]),
      beyond: judged?.lengths?.[pick.id]?.beyond ?? false,
    };
  });

/**
 * @param {Row[]} rows
 * @param {string[]} chosen names of FILTERS
 * @returns {Row[]}
 */
export const filtered = (rows, chosen) => {
  /** @type {Map<string, Filter[]>} */
  const groups = new Map();
  for (const filter of FILTERS) {
    if (!chosen.includes(filter.name)) continue;
    groups.set(filter.group, [...(groups.get(filter.group) ?? []), filter]);
  }
  return rows.filter((row) => [...groups.values()].every((group) => group.some(({ keeps }) => keeps(row))));
};

/**
 * Compute which rows are visible, with some spare ones above and below.
 * @param {{top: number, height: number, row: number, count: number, spare?: number}} of px
 * @returns {[number, number]} first and end (exclusive)
 */
export const visibleRange = ({ top, height, row, count, spare = 6 }) => {
  const first = Math.max(0, Math.floor(top / row) - spare);
  return [Math.min(first, count), Math.min(count, Math.ceil((top + height) / row) + spare)];
};

/**
 * List the ids from one row to another, in the order of the table.
 * @param {Row[]} rows
 * @param {string} from
 * @param {string} to
 * @returns {string[]} only `to` if `from` is not among the rows
 */
export const idsBetween = (rows, from, to) => {
  const [a, b] = [from, to].map((id) => rows.findIndex((row) => row.id === id));
  if (b < 0) return [];
  if (a < 0) return [to];
  return rows.slice(Math.min(a, b), Math.max(a, b) + 1).map(({ id }) => id);
};
