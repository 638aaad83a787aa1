/**
 * Matches of which only one side is drawn survive a reload of the page, and wait for their project while another is
 * open in the workbench.
 */

const KEY = "ladarreg-unfinished";

const read = (key) => {
  try {
    return JSON.parse(sessionStorage.getItem(key) ?? "null");
  } catch {
    return null; // storage is disabled, or was written by an older page
  }
};

const write = (key, value) => {
  try {
    if (value) sessionStorage.setItem(key, JSON.stringify(value));
    else sessionStorage.removeItem(key);
  } catch {
    // storage is disabled or full: a reload loses them
  }
};

/**
 * @param {import("./picking.js").Picking} picking
 * @param {import("../net/store.js").Store} store
 */
export const keepUnfinished = (picking, store) => {
  let key = null;
  const scanId = () => store.get("scan")?.id ?? null;
  store.on("project", (project) => {
    if (key || !project) return; // the page belongs to its first project
    key = `${KEY}:${project.id}`;
    const kept = read(key);
    if (kept && kept.scan === scanId()) picking.restore(kept.drawn);
    write(key, null);
  });
  addEventListener("pagehide", () => {
    const drawn = picking.kept();
    if (key && drawn.length) write(key, { scan: scanId(), drawn });
  });
};
