/** Questions to the workbench while the pointer moves: not too many, and always the last one. */

/**
 * Return a function that asks at most once an interval, and never while an answer is out; of several wishes in between
 * the newest is asked.
 * @template Wish
 * @param {(wish: Wish) => Promise<any>} ask
 * @param {number} interval_ms
 * @returns {((wish: Wish) => void) & {forget: () => void}}
 */
export const throttled = (ask, interval_ms) => {
  let waiting = null;
  let timer = 0;
  let out = false;
  let last = -Infinity;

  const go = async () => {
    timer = 0;
    if (!waiting || out) return;
    const { wish } = waiting;
    waiting = null;
    out = true;
    last = performance.now();
    try {
      await ask(wish);
    } catch {
      // What is asked in passing is asked again with the next move.
    }
    out = false;
    plan();
  };

  const plan = () => {
    if (!waiting || timer || out) return;
    timer = setTimeout(go, Math.max(0, last + interval_ms - performance.now()));
  };

  const wish = (what) => {
    waiting = { wish: what };
    plan();
  };
  wish.forget = () => {
    waiting = null;
  };
  return wish;
};
