/** The match table's rows: joining picks with what the pose says of them, filtering and sorting. No DOM here. */

/**
 * @typedef {{id: string, number: number, kind: string, origin: string, on: boolean, weight: number,
 *            sampled: number | null, used: number | null, px: number | null, mm: number | null, depth_m: number | null,
 *            influence: number | null, inlier: boolean | null, judged: boolean}} Row
 */

const MADE_BY_HAND = new Set(["manual", "file"]);

/** What the filter chips show; those of one group widen each other, the groups narrow each other. */
export const FILTERS = [
  { name: "lines", one: "line", group: "kind", keeps: (row) => row.kind === "line" },
  { name: "points", one: "point", group: "kind", keeps: (row) => row.kind === "point" },
  { name: "found", group: "state", keeps: (row) => !MADE_BY_HAND.has(row.origin) },
  { name: "off", group: "state", keeps: (row) => !row.on },
  { name: "rejected", group: "state", keeps: (row) => row.on && row.inlier === false },
];

/**
 * @param {import("../net/store.js").Pick[]} picks
 * @param {any} judged slice `judged:pID`, or null
 * @returns {Row[]}
 */
export const rowsOf = (picks, judged) =>
  picks.map((pick) => {
    const said = judged?.by_pick?.[pick.id];
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
      px: said?.px ?? null,
      mm: said?.mm ?? null,
      depth_m: said?.depth_m ?? null,
      influence: said?.influence ?? null,
      inlier: said?.inlier ?? null,
      judged: said !== undefined,
    };
  });

/**
 * @param {Row[]} rows
 * @param {string[]} chosen names of FILTERS
 * @returns {Row[]}
 */
export const filtered = (rows, chosen) => {
  const groups = new Map();
  for (const filter of FILTERS) {
    if (!chosen.includes(filter.name)) continue;
    groups.set(filter.group, [...(groups.get(filter.group) ?? []), filter]);
  }
  return rows.filter((row) => [...groups.values()].every((group) => group.some(({ keeps }) => keeps(row))));
};

/** What is sorted by its size, the sign apart: a depth error of -0.3 m is worse than one of 0.1 m. */
const VALUES = {
  on: (row) => (row.on ? 1 : 0),
  number: (row) => row.number,
  kind: (row) => row.kind,
  origin: (row) => row.origin,
  samples: (row) => row.used,
  px: (row) => row.px,
  mm: (row) => row.mm,
  depth_m: (row) => (row.depth_m === null ? null : Math.abs(row.depth_m)),
  influence: (row) => row.influence,
  weight: (row) => row.weight,
};

/**
 * Sort without changing the given array; rows without a value come last either way, equals by number.
 * @param {Row[]} rows
 * @param {{by: string, descending: boolean}} sort
 * @returns {Row[]}
 */
export const sorted = (rows, { by, descending }) => {
  const value = VALUES[by] ?? VALUES.number;
  const sign = descending ? -1 : 1;
  return [...rows].sort((a, b) => {
    const [left, right] = [value(a), value(b)];
    if (left === null || right === null) return left === right ? a.number - b.number : left === null ? 1 : -1;
    if (left !== right) return left < right ? -sign : sign;
    return a.number - b.number;
  });
};

/**
 * The rows that are in sight, with some above and below.
 * @param {{top: number, height: number, row: number, count: number, spare?: number}} of px
 * @returns {[number, number]} first and end (exclusive)
 */
export const inSight = ({ top, height, row, count, spare = 6 }) => {
  const first = Math.max(0, Math.floor(top / row) - spare);
  return [Math.min(first, count), Math.min(count, Math.ceil((top + height) / row) + spare)];
};

/**
 * The ids from one row to another, in the order of the table.
 * @param {Row[]} rows
 * @param {string} from
 * @param {string} to
 * @returns {string[]} only `to` where `from` is not among the rows
 */
export const between = (rows, from, to) => {
  const [a, b] = [from, to].map((id) => rows.findIndex((row) => row.id === id));
  if (b < 0) return [];
  if (a < 0) return [to];
  return rows.slice(Math.min(a, b), Math.max(a, b) + 1).map(({ id }) => id);
};
