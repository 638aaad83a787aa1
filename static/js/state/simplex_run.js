/** The newest run of the simplex on the shown photograph: what is shown of it, live or replayed. No DOM here. */

const MAX_FRAMES = 600;
const EXPIRES_AFTER_MS = 2500;
const TICK_MS = 40;

/** @typedef {import("../protocol.d.ts").SimplexEvent} Frame */

/** The frames of a run; every second one is dropped when they become too many. */
export class SimplexRun {
  /** @type {Frame[]} thinned out */
  #frames = [];
  #every = 1;
  #seen = 0;
  /** @type {Frame | null} */
  #last = null;
  /** @type {Frame | null} what the pictures show of it now; null: nothing */
  current = null;
  /** Whether it is being replayed. */
  playing = false;
  /** Iterations a second of the replay. */
  speed = 60;
  #timer = 0;
  #begun = { at_ms: 0, iteration: 0 };
  /** @type {Set<() => void>} */
  #listeners = new Set();
  #now;

  /** @param {() => number} [now] the time, ms */
  constructor(now = () => performance.now()) {
    this.#now = now;
  }

  /** @returns {Frame[]} always ending with the newest */
  get frames() {
    return this.#last && this.#frames.at(-1) !== this.#last ? [...this.#frames, this.#last] : this.#frames;
  }

  /** @returns {Frame | null} the newest frame */
  get newest() {
    return this.#last;
  }

  /** Call `listen()` whenever a frame arrives, another one is shown, or none. @param {() => void} listen */
  onChange(listen) {
    this.#listeners.add(listen);
  }

  /** Take a frame of the running solver, and show it. @param {Frame} frame */
  add(frame) {
    if (this.#last && (frame.iteration < this.#last.iteration || frame.photo !== this.#last.photo)) this.clear();
    this.#last = frame;
    if (this.#seen++ % this.#every === 0) this.#frames.push(frame);
    if (this.#frames.length > MAX_FRAMES) {
      this.#frames = this.#frames.filter((_, index) => index % 2 === 0);
      this.#every *= 2;
    }
    this.playing = false;
    this.#show(frame);
  }

  /** Forget the run. */
  clear() {
    this.#frames = [];
    this.#every = 1;
    this.#seen = 0;
    this.#last = null;
    this.playing = false;
    this.#show(null);
  }

  /** Replay it, from what is shown or from its beginning; `tick` then shows one frame after the other. */
  play() {
    const { frames } = this;
    if (frames.length < 2) return;
    const from = this.current && this.current !== this.#last ? this.current : frames[0];
    this.playing = true;
    this.#begun = { at_ms: this.#now(), iteration: from.iteration };
    this.#show(from);
    clearInterval(this.#timer);
    this.#timer = setInterval(() => this.tick(), TICK_MS);
  }

  /** Hold the replay where it is. */
  hold() {
    this.playing = false;
    this.#show(this.current);
  }

  /** Replay at another speed from now on. @param {number} speed iterations a second */
  pace(speed) {
    this.speed = speed;
    if (this.playing && this.current) this.#begun = { at_ms: this.#now(), iteration: this.current.iteration };
  }

  /** Show one frame, and hold there. @param {number} index in `frames` */
  seek(index) {
    this.playing = false;
    this.#show(this.frames[index] ?? null);
  }

  /** Show no frame: the pose that was found takes its place. */
  leave() {
    if (!this.current) return;
    this.playing = false;
    this.#show(null);
  }

  /** Show the frame that is due. */
  tick() {
    if (!this.playing) {
      clearInterval(this.#timer);
      return;
    }
    const due = this.#begun.iteration + ((this.#now() - this.#begun.at_ms) / 1000) * this.speed;
    const { frames } = this;
    const shown = frames.findLast(({ iteration }) => iteration <= due) ?? frames[0];
    if (shown === frames.at(-1)) this.playing = false;
    if (shown !== this.current || !this.playing) this.#show(shown);
  }

  /** @param {Frame | null} frame */
  #show(frame) {
    if (!this.playing) clearInterval(this.#timer);
    this.current = frame;
    for (const listen of [...this.#listeners]) listen();
  }
}

/** The run on this page. */
export const simplexRun = new SimplexRun();

/**
 * Follow the solver: its frames are shown as they come, and until it has ended.
 * @param {import("../net/store.js").Store} store
 */
export const followSimplex = (store) => {
  let live = false;
  let timer = 0;
  const end = () => {
    clearTimeout(timer);
    if (live) simplexRun.leave();
    live = false;
  };
  store.onEvent("simplex", (frame) => {
    if (frame.photo !== store.shown()) return;
    live = true;
    simplexRun.add(frame);
    clearTimeout(timer);
    // a paused solver stays; one without further steps has ended
    timer = setTimeout(() => store.get("job")?.state !== "paused" && end(), EXPIRES_AFTER_MS);
  });
  store.on("job", (job) => (!job || !["running", "paused"].includes(job.state)) && end());
  store.on("shown", (shown) => shown !== simplexRun.newest?.photo && simplexRun.clear());
};
