/** Applying the changes that the server sends of a slice (docs/workbench.md); app/gateway/delta.py computes them. */

/**
 * @typedef {{set?: any, gone?: (string | number)[], in?: Record<string, Change>, order?: (string | number)[]}} Change
 */

/** @param {any} item @returns {string | number} */
const keyOf = (item) => item.id ?? item.n;

/** @param {any[]} before @param {Change} change */
const changedList = (before, { set = [], gone = [], order }) => {
  const removed = new Set(gone);
  const items = new Map();
  for (const item of before) if (!removed.has(keyOf(item))) items.set(keyOf(item), item);
  for (const item of set) items.set(keyOf(item), item);
  if (!order) return [...items.values()];
  const complete = order.length === items.size && order.every((key) => items.has(key));
  if (!complete) throw new RangeError("the order is of another list");
  return order.map((key) => items.get(key));
};

/** @param {Record<string, any>} before @param {Change} change */
const changedObject = (before, { set = {}, gone = [], in: inner = {} }) => {
  const after = { ...before, ...set };
  for (const name of gone) delete after[name];
  for (const [name, change] of Object.entries(inner)) after[name] = changed(before[name], change);
  return after;
};

/**
 * Apply a change to a value. The value itself is not modified, and its unchanged parts stay the same objects.
 * @param {any} before
 * @param {Change} change
 * @returns {any} the new value
 * @throws {RangeError} if the change does not fit the value
 */
export const changed = (before, change) => {
  if (before === null || typeof before !== "object") throw new RangeError("the value is neither an object nor a list");
  return Array.isArray(before) ? changedList(before, change) : changedObject(before, change);
};
