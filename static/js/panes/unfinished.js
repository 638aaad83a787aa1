/**
 * Matches of which only one side is drawn survive a reload of the page, and wait for their project while another is
 * open in the workbench.
 */

const KEY = "ladarreg-unfinished";

/** @param {string} key @returns {Kept | null} */
const read = (key) => {
  try {
    return JSON.parse(sessionStorage.getItem(key) ?? "null");
  } catch {
    return null; // storage is disabled, or was written by an older page
  }
};

/** @param {string} key @param {Kept | null} value */
const write = (key, value) => {
  try {
    if (value) sessionStorage.setItem(key, JSON.stringify(value));
    else sessionStorage.removeItem(key);
  } catch {
    // storage is disabled or full: a reload loses them
  }
};

/** @typedef {{scan: string | null, drawn: [string, import("./picking.js").Drawn][]}} Kept */

/**
 * @param {import("./picking.js").Picking} picking
 * @param {import("../net/store.js").Store} store
 */
export const keepUnfinished = (picking, store) => {
  /** @param {{id: string}} project */
  const keyOf = (project) => `${KEY}:${project.id}`;
  /** @type {string | null} */
  let key = null;
  /** @type {string | null} */
  let scan = null; // what is drawn belongs to it, even while slices of another project arrive
  /** @type {Kept | null} */
  let awaited = null;
  let left = false;

  const keep = () => {
    const drawn = picking.kept();
    if (key && !left && !awaited && drawn.length) write(key, { scan, drawn });
  };
  const leave = () => {
    keep();
    left = true;
  };
  store.onEvent("project", leave);
  store.on("project", (project) => {
    if (!project) return;
    if (!key) {
      key = keyOf(project);
      awaited = read(key);
    } else if (keyOf(project) !== key) leave();
  });
  store.watch(["project", "scan", "beside"], () => {
    scan = store.scanBeside()?.grid ?? store.scanBeside()?.id ?? null;
    if (!key || left || !awaited) return;
    if (awaited.scan && !scan) return; // the scan may still be being read
    if (awaited.scan === scan) for (const [photo, first] of awaited.drawn) picking.reopen(first, photo);
    awaited = null;
    write(key, null);
  });
  addEventListener("pagehide", keep);
};
