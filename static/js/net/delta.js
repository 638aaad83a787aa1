/** How a slice becomes another by what the server tells of it (docs/workbench.md): what app/gateway/delta.py made. */

/**
 * @typedef {{set?: any, gone?: (string | number)[], in?: Record<string, Change>, order?: (string | number)[]}} Change
 */

const keyOf = (thing) => thing.id ?? thing.n;

const changedList = (before, { set = [], gone = [], order }) => {
  const left = new Set(gone);
  const things = new Map();
  for (const thing of before) if (!left.has(keyOf(thing))) things.set(keyOf(thing), thing);
  for (const thing of set) things.set(keyOf(thing), thing);
  if (!order) return [...things.values()];
  if (order.length !== things.size || !order.every((key) => things.has(key))) throw new RangeError("other things");
  return order.map((key) => things.get(key));
};

const changedObject = (before, { set = {}, gone = [], in: inner = {} }) => {
  const found = { ...before, ...set };
  for (const name of gone) delete found[name];
  for (const [name, change] of Object.entries(inner)) found[name] = changed(before[name], change);
  return found;
};

/**
 * Return what a change makes of a value; the value stays as it is, and what did not change stays the same object.
 * @param {any} before
 * @param {Change} change
 * @returns {any}
 * @throws {RangeError} if the change is one of another value
 */
export const changed = (before, change) => {
  if (before === null || typeof before !== "object") throw new RangeError("nothing that could change so");
  return Array.isArray(before) ? changedList(before, change) : changedObject(before, change);
};
