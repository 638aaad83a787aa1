/** Limits on how often something is done: once an interval, or once a frame. */

/**
 * Return a function that calls `act` at most once an interval and never while an earlier call is unfinished. Of several
 * requests in between, only the newest is carried out.
 * @template {any[]} Given
 * @param {(...given: Given) => any} act may be asynchronous; its failure is ignored, since the next request follows
 * @param {number} interval_ms
 * @returns {((...given: Given) => void) & {forget: () => void}} `forget` drops a request that has not begun
 */
export const throttled = (act, interval_ms) => {
  /** @type {Given | null} */
  let waiting = null;
  let timer = 0;
  let busy = false;
  let last = -Infinity;

  const go = async () => {
    timer = 0;
    if (!waiting || busy) return;
    const given = waiting;
    waiting = null;
    busy = true;
    last = performance.now();
    try {
      await act(...given);
    } catch {
      // the next request replaces this one
    }
    busy = false;
    plan();
  };

  const plan = () => {
    if (!waiting || timer || busy) return;
    timer = setTimeout(go, Math.max(0, last + interval_ms - performance.now()));
  };

  const request = (/** @type {Given} */ ...given) => {
    waiting = given;
    plan();
  };
  request.forget = () => {
    waiting = null;
  };
  return request;
};

/**
 * Return a function that calls `draw` once in the next frame, however often it is called before.
 * @param {() => void} draw
 * @returns {() => void}
 */
export const inNextFrame = (draw) => {
  let frame = 0;
  return () => {
    frame ||= requestAnimationFrame(() => {
      frame = 0;
      draw();
    });
  };
};
