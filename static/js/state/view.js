/**
 * The state of this page alone: selection, tool, display of the pictures. It survives a reload (sessionStorage), is not
 * part of the document and is not subject to undo.
 */

/**
 * @typedef {object} ViewState
 * @property {Set<string>} selected ids of the selected picks
 * @property {{side: "scan" | "photo", index: number} | null} end the selected end of the only selected pick
 * @property {string | null} hovered id of the pick under the pointer, anywhere
 * @property {"line" | "point" | "select" | "measure"} tool
 * @property {import("../protocol.d.ts").Measurement["kind"]} measures kind of measurement, see `MEASURES`
 * @property {string | null} measurement id of the selected measurement
 * @property {boolean} linked the panes are linked
 * @property {boolean} snap lines snap to the edge under them, points to a corner
 * @property {boolean} loupe
 * @property {boolean} corners detected corners are shown
 * @property {boolean} marks matches are shown in the pictures; a selected one, and that under the pointer, always
 * @property {{show: string, low: number, high: number, equalise: boolean, gamma: number, brightness: number,
 *             contrast: number, view: number}} scan
 * @property {boolean} stretching a slider of the scan's contrast is being dragged: its picture is previewed, not loaded
 * @property {{brightness: number, contrast: number, overlay: "none" | "blend" | "swipe" | "checker" | "edges",
 *             blend: number, swipe: number}} photo
 * @property {null | "scan" | "photo" | "model"} filled the maximised pane
 * @property {{by: string, descending: boolean}} sort of the match table
 * @property {string[]} filter of the match table: "lines", "points", "found", "off", "rejected"
 * @property {{by: "depth" | "px", above: {depth: number | null, px: number | null}}} threshold of the depth-error plot
 * @property {"acquire" | "stations" | "match" | "solve" | "judge" | "export"} step
 * @property {{photo: string, pose: number[][]} | null} placement a camera that is being placed by hand: its photograph and
 *   camera_from_scanner
 * @property {string | null} offer id of a match that the panes offer to show; reset to null once it is offered
 * @property {string | null} reveal id of a match to show; reset to null once it is shown
 * @property {{side: "scan" | "photo", uv: number[]} | null} reveal_uv a pixel to show, likewise
 * @property {{ray: number[], uv: number[] | null} | null} reveal_place a ray of the scan, and a pixel of the photograph,
 *   to show, likewise
 * @property {string | null} smoothed id of the range of a smoothing that is pointed at
 * @property {boolean} smooth_edges ranges at depth edges would be smoothed, too
 * @property {{side: "scan" | "photo", uv: number[], range_m?: number | null, intensity?: number | null,
 *             edge?: {near_m: number, far_m: number, near: number[], far: number[]} | null, zoom?: number} | null} readout
 *   values under the cursor; `edge`: the surfaces on both sides of a depth edge
 * @property {string | null} hint one sentence on what the current tool expects next
 * @property {string | null} tying id of a photograph from which ties are drawn to another, in a dialog
 * @property {{left: number | null, middle: number | null, dock: number | null}} layout shares of the window, 0 to 1;
 *   null: as suits the pictures
 */

/**
 * @typedef {"scan" | "photo" | "layout"} Nested of several values, which change one by one
 * @typedef {Partial<Omit<ViewState, Nested>> & {[Name in Nested]?: Partial<ViewState[Name]>}} ViewPatch
 */

const KEY = "ladarreg-view";
const TRANSIENT = new Set(["stretching", "hovered", "placement", "offer", "reveal", "reveal_uv", "reveal_place", "smoothed", "smooth_edges", "readout", "hint", "tying"]);

/** @returns {ViewState} */
const defaults = () => ({
  selected: new Set(),
  end: null,
  hovered: null,
  tool: "line",
  measures: "distance",
  measurement: null,
  linked: false,
  snap: true,
  loupe: true,
  corners: true,
  marks: true,
  scan: { show: "intensity", low: 1, high: 99.5, equalise: false, gamma: 0.6, brightness: 1, contrast: 1, view: 0 },
  stretching: false,
  photo: { brightness: 1, contrast: 1, overlay: "none", blend: 0.5, swipe: 0.5 },
  filled: null,
  sort: { by: "number", descending: false },
  filter: [],
  threshold: { by: "depth", above: { depth: null, px: null } },
  step: "match",
  placement: null,
  offer: null,
  reveal: null,
  reveal_uv: null,
  reveal_place: null,
  smoothed: null,
  smooth_edges: false,
  readout: null,
  hint: null,
  tying: null,
  layout: { left: null, middle: null, dock: null },
});

/** @returns {ViewPatch} */
const stored = () => {
  try {
    const found = JSON.parse(sessionStorage.getItem(KEY) ?? "{}");
    return { ...found, selected: new Set(Array.isArray(found.selected) ? found.selected : []) };
  } catch {
    return {}; // storage is disabled, or was written by an older page
  }
};

/** @param {ViewState} base @param {ViewPatch} patch @returns {ViewState} */
const merged = (base, patch) => ({
  ...base,
  ...patch,
  scan: patch.scan ? { ...base.scan, ...patch.scan } : base.scan,
  photo: patch.photo ? { ...base.photo, ...patch.photo } : base.photo,
  layout: patch.layout ? { ...base.layout, ...patch.layout } : base.layout,
});

/** The state with its listeners; `set` is the only way to change it. */
class View {
  #state = merged(defaults(), stored());
  /** @type {Set<(state: ViewState, changed: Set<keyof ViewState>) => void>} */
  #listeners = new Set();
  #saving = 0;
  #left = false; // another project is about to be shown

  /** @returns {Readonly<ViewState>} the state, not to be modified in place */
  get() {
    return this.#state;
  }

  /**
   * Change parts of the state; `scan`, `photo` and `layout` may be given in part.
   * @param {ViewPatch} patch
   */
  set(patch) {
    const before = this.#state;
    this.#state = merged(before, patch);
    const names = /** @type {(keyof ViewState)[]} */ (Object.keys(patch));
    const changed = new Set(names.filter((name) => before[name] !== this.#state[name]));
    if (changed.size === 0) return;
    if ([...changed].some((name) => !TRANSIENT.has(name))) this.#save();
    for (const listen of [...this.#listeners]) listen(this.#state, changed);
  }

  /**
   * Call `listen(state, changed)` at each change; `changed` is the set of the changed names.
   * @param {(state: ViewState, changed: Set<keyof ViewState>) => void} listen
   * @returns {() => void} removes the listener
   */
  on(listen) {
    this.#listeners.add(listen);
    return () => this.#listeners.delete(listen);
  }

  /**
   * Leave this project for another: the next load of the page has what it had when it left that one.
   * @param {string} from id of this project
   * @param {string} to id of the other
   */
  exchange(from, to) {
    this.#saveNow();
    clearTimeout(this.#saving);
    this.#left = true;
    try {
      sessionStorage.setItem(`${KEY}:${from}`, sessionStorage.getItem(KEY) ?? "{}");
      const kept = sessionStorage.getItem(`${KEY}:${to}`);
      if (kept === null) sessionStorage.removeItem(KEY);
      else sessionStorage.setItem(KEY, kept);
    } catch {
      // storage is disabled: nothing was kept
    }
  }

  #save() {
    if (this.#left) return;
    clearTimeout(this.#saving);
    this.#saving = setTimeout(() => this.#saveNow(), 200);
  }

  #saveNow() {
    const lasting = Object.entries(this.#state).filter(([name]) => !TRANSIENT.has(name));
    const plain = { ...Object.fromEntries(lasting), selected: [...this.#state.selected] };
    try {
      sessionStorage.setItem(KEY, JSON.stringify(plain));
    } catch {
      // storage is disabled or full: the page works, but a reload resets it
    }
  }
}

export const view = new View();
