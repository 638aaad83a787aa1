/** Thresholds, scales and bins of the depth-error plot. No DOM here. */

const USUAL_THRESHOLDS = 3; // on the axis; larger errors become arrows
const ROOM = 1.15;

/**
 * @typedef {{id: string, number: number, value: number, on: boolean, inlier: boolean | null,
 *   agrees: boolean | null}} Stem
 */

/**
 * Select the matches that have an error, in the order of the document.
 * @param {import("../matches/match_rows.js").Row[]} rows
 * @param {"depth" | "px"} by
 * @returns {Stem[]}
 */
export const stemsOf = (rows, by) =>
  rows.flatMap(({ id, number, on, inlier, agrees, depth_m, px }) => {
    const value = by === "depth" ? depth_m : px;
    return value !== null && Number.isFinite(value) ? [{ id, number, on, inlier, agrees, value }] : [];
  });

/** @param {number} value @returns {number} rounded to two significant figures */
export const rounded = (value) => (value > 0 ? Number(value.toPrecision(2)) : 0);

/**
 * Preview of the command `reject`, which disables the matches above the threshold and re-enables those below.
 * @param {Stem[]} stems
 * @param {number | null} above
 * @returns {{above: Set<string>, off: number, on: number}} the matches above; how many are disabled, and re-enabled
 */
export const rejection = (stems, above) => {
  const beyond = (/** @type {Stem} */ stem) => above !== null && Math.abs(stem.value) > above;
  return {
    above: new Set(stems.filter(beyond).map(({ id }) => id)),
    off: stems.filter((stem) => stem.on && beyond(stem)).length,
    on: above === null ? 0 : stems.filter((stem) => !stem.on && !beyond(stem)).length,
  };
};

/**
 * The largest value on the axis: a single gross error must not compress all others.
 * @param {Stem[]} stems
 * @param {number | null} above
 * @returns {number} > 0
 */
export const reach = (stems, above) => {
  const largest = Math.max(0, ...stems.map(({ value }) => Math.abs(value)));
  const shown = above === null ? largest : Math.min(largest, USUAL_THRESHOLDS * above);
  return ROOM * Math.max(shown, 1.1 * (above ?? 0)) || 1;
};

/**
 * Round tick values of an axis.
 * @param {number} least
 * @param {number} most
 * @param {number} about approximate number of ticks
 * @returns {number[]}
 */
export const marks = (least, most, about) => {
  const rough = (most - least) / Math.max(1, about);
  if (!(rough > 0) || !Number.isFinite(rough)) return [];
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((factor) => factor * power).find((each) => each >= rough) ?? 10 * power;
  const found = [];
  for (let k = Math.ceil(least / step); k * step <= most + step / 1e6; k += 1) found.push(
    Number((k * step).toPrecision(12)),
  );
  return found;
};

/** @param {number[]} values @returns {number} decimals that distinguish the ticks */
export const decimalsOf = (values) => {
  if (values.length < 2) return 1;
  return Math.max(0, Math.min(6, -Math.floor(Math.log10(Math.abs(values[1] - values[0])) + 1e-9)));
};

/**
 * Count the errors in equal bins; those beyond the axis belong to the outermost bins.
 * @param {Stem[]} stems
 * @param {number} least
 * @param {number} most
 * @param {number} count of bins
 * @returns {{on: number[], off: number[]}} counts of the enabled and of the disabled matches
 */
export const histogram = (stems, least, most, count) => {
  const bins = { on: new Array(count).fill(0), off: new Array(count).fill(0) };
  for (const { value, on } of stems) {
    const at = Math.floor(((value - least) / (most - least)) * count);
    (on ? bins.on : bins.off)[Math.max(0, Math.min(count - 1, at))] += 1;
  }
  return bins;
};

/**
 * @param {number} above
 * @param {boolean} up
 * @param {boolean} fast
 * @returns {number} the threshold after an arrow key: 2 % more or less, 20 % with Shift
 */
export const stepped = (above, up, fast) => {
  const factor = fast ? 1.2 : 1.02;
  return Number((up ? above * factor : above / factor).toPrecision(3));
};
