/** The speed of the link to the workbench, as the browser has measured it on what it has loaded. */

const FAST_BYTES_PER_MS = 1000; // 8 Mbit/s: an exact picture of a megabyte takes a second
const MIN_BYTES = 8000;
const RECENT = 6;

/** @type {number[]} bytes per ms */
let speeds = [];

/** @param {PerformanceEntryList} entries */
const note = (entries) => {
  for (const entry of entries) {
    if (!(entry instanceof PerformanceResourceTiming)) continue;
    const { transferSize, encodedBodySize, responseStart, responseEnd } = entry;
    // what comes from the browser's cache, or is small, says nothing about the link
    if (encodedBodySize < MIN_BYTES || transferSize < encodedBodySize) continue;
    // the clock of a page is coarse; a download within one of its ticks is a fast one
    speeds = [...speeds, encodedBodySize / Math.max(1, responseEnd - responseStart)].slice(-RECENT);
  }
};

const observer = new PerformanceObserver((list) => note(list.getEntries()));
observer.observe({ type: "resource", buffered: true });
note(performance.getEntriesByType("resource"));

/** @returns {boolean | null} whether whole exact pictures load quickly; null before anything was measured */
export const linkIsFast = () => {
  note(observer.takeRecords());
  return speeds.length === 0 ? null : Math.max(...speeds) >= FAST_BYTES_PER_MS;
};
