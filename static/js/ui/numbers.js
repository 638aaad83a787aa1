/** Formatting of numbers, sizes, durations and sentences. */

export const NONE = "–";
const MINUS = "−";

/** @type {(value: unknown) => value is number} whether there is a number to show */
export const isNumber = (value) => typeof value === "number" && Number.isFinite(value);

/**
 * @param {number | null | undefined} value
 * @param {number} decimals
 * @returns {string} with a typographic minus; a dash if there is no number
 */
export const fixed = (value, decimals) => {
  if (!isNumber(value)) return NONE;
  const text = value.toFixed(decimals);
  return Number(text) === 0 ? text.replace("-", "") : text.replace("-", MINUS);
};

/** @param {number | null | undefined} value @returns {string} with three significant figures, and at most four decimals */
export const short = (value) => {
  if (!isNumber(value)) return NONE;
  const size = Math.abs(value);
  return fixed(value, size >= 100 ? 0 : size >= 10 ? 1 : size >= 1 ? 2 : size >= 0.1 ? 3 : 4);
};

/** @param {string | number | null | undefined} text @returns {string} a number formatted by the server, with a typographic minus */
export const typeset = (text) => String(text ?? NONE).replace(/^-/, MINUS);

/** @param {number} count @returns {string} such as `24.1 MB` */
export const bytes = (count) => {
  if (count >= 2 ** 30) return `${(count / 2 ** 30).toFixed(1)} GB`;
  if (count >= 2 ** 20) return `${(count / 2 ** 20).toFixed(1)} MB`;
  return count >= 1024 ? `${Math.round(count / 1024)} kB` : `${count} B`;
};

/** @param {number | null | undefined} seconds @returns {string} such as `0.42 s` or `3 min 05 s` */
export const duration = (seconds) => {
  if (!isNumber(seconds)) return NONE;
  if (seconds < 10) return `${seconds.toFixed(seconds < 1 ? 2 : 1)} s`;
  if (seconds < 60) return `${Math.round(seconds)} s`;
  return `${Math.floor(seconds / 60)} min ${String(Math.round(seconds % 60)).padStart(2, "0")} s`;
};

/** @param {number} count @param {string} one @param {string} [many] @returns {string} `1 match`, `3 matches` */
export const counted = (count, one, many = `${one}s`) => `${count} ${count === 1 ? one : many}`;

/** @type {Record<string, string>} */
const GREEK = { alpha: "α", beta: "β", gamma: "γ" };
/** @type {Record<string, string>} */
const UNITS = { deg: "°" };

/** @param {{name: string, unit: string}} parameter @returns {string} name and unit of a parameter, such as `α °` */
export const parameterName = ({ name, unit }) => `${GREEK[name] ?? name} ${UNITS[unit] ?? unit}`;

/** @param {unknown[]} texts @returns {string} the texts as consecutive sentences, each with a capital letter and a full stop */
export const sentences = (texts) =>
  texts
    .map((text) => String(text).trim().replaceAll("chi^2", "χ²"))
    .filter(Boolean)
    .map((text) => `${text[0].toUpperCase()}${text.slice(1)}${/[.!?]$/.test(text) ? "" : "."}`)
    .join(" ");
