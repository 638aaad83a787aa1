/**
 * What this page alone knows: selection, tools, how the pictures are shown. It survives a reload (sessionStorage),
 * never enters the document and is not undone.
 */

/**
 * @typedef {object} ViewState
 * @property {Set<string>} selected ids of the selected picks
 * @property {{side: "scan" | "photo", index: number} | null} end the selected end of the only selected pick
 * @property {string | null} hovered id of the pick under the pointer, anywhere
 * @property {"line" | "point" | "select"} tool
 * @property {boolean} linked both panes show the same place
 * @property {boolean} snap end points go to the nearest corner
 * @property {boolean} loupe
 * @property {boolean} corners that were found are shown
 * @property {{show: string, low: number, high: number, equalise: boolean, gamma: number, brightness: number,
 *             contrast: number, view: number}} scan
 * @property {{brightness: number, contrast: number, overlay: "none" | "blend" | "swipe" | "checker" | "edges",
 *             blend: number, swipe: number}} photo
 * @property {null | "scan" | "photo" | "model"} filled the pane that has the whole width
 * @property {{by: string, descending: boolean}} sort of the match table
 * @property {string[]} filter of the match table: "lines", "points", "found", "off", "rejected"
 * @property {{by: "depth" | "px", above: {depth: number | null, px: number | null}}} threshold of the depth-error plot
 * @property {"match" | "solve" | "judge" | "export"} step
 * @property {"dark" | "light" | "system"} theme
 * @property {string | null} reveal id of the pick to bring into sight; whoever does so sets null again
 * @property {{side: "scan" | "photo", uv: number[]} | null} reveal_uv the place to bring into sight, likewise
 * @property {{side: "scan" | "photo", uv: number[], range_m?: number | null, intensity?: number | null,
 *             zoom?: number} | null} readout what is under the cursor
 * @property {string | null} hint one sentence on what the tool in hand expects next
 * @property {{left: number, middle: number, dock: number}} layout shares of the window, 0 to 1
 */

const KEY = "ladarreg-view";
const PASSING = new Set(["hovered", "reveal", "reveal_uv", "readout", "hint"]);
const NESTED = ["scan", "photo", "layout"];

/** @returns {ViewState} */
const fresh = () => ({
  selected: new Set(),
  end: null,
  hovered: null,
  tool: "line",
  linked: false,
  snap: true,
  loupe: true,
  corners: true,
  scan: { show: "intensity", low: 1, high: 99.5, equalise: false, gamma: 0.6, brightness: 1, contrast: 1, view: 0 },
  photo: { brightness: 1, contrast: 1, overlay: "none", blend: 0.5, swipe: 0.5 },
  filled: null,
  sort: { by: "number", descending: false },
  filter: [],
  threshold: { by: "depth", above: { depth: null, px: null } },
  step: "match",
  theme: "system",
  reveal: null,
  reveal_uv: null,
  readout: null,
  hint: null,
  layout: { left: 0.325, middle: 0.325, dock: 0.33 },
});

const kept = () => {
  try {
    const found = JSON.parse(sessionStorage.getItem(KEY) ?? "{}");
    return { ...found, selected: new Set(Array.isArray(found.selected) ? found.selected : []) };
  } catch {
    return {}; // storage is off, or holds what an older page wrote
  }
};

const merged = (base, patch) => {
  const result = { ...base, ...patch };
  for (const name of NESTED) if (patch[name]) result[name] = { ...base[name], ...patch[name] };
  return result;
};

/** State of this page with listeners; `set` is the only way to change it. */
class View {
  #state = merged(fresh(), kept());
  #listeners = new Set();
  #saving = 0;

  /** @returns {Readonly<ViewState>} the state; never change it in place */
  get() {
    return this.#state;
  }

  /**
   * Change some of it; `scan`, `photo` and `layout` may be given in part.
   * @param {Partial<ViewState> | Record<string, any>} patch
   */
  set(patch) {
    const before = this.#state;
    this.#state = merged(before, patch);
    const changed = new Set(Object.keys(patch).filter((name) => before[name] !== this.#state[name]));
    if (changed.size === 0) return;
    if ([...changed].some((name) => !PASSING.has(name))) this.#save();
    for (const listen of [...this.#listeners]) listen(this.#state, changed);
  }

  /**
   * Call `listen(state, changed)` at each change; `changed` is the set of the names that were set.
   * @param {(state: ViewState, changed: Set<string>) => void} listen
   * @returns {() => void} stops it
   */
  on(listen) {
    this.#listeners.add(listen);
    return () => this.#listeners.delete(listen);
  }

  #save() {
    clearTimeout(this.#saving);
    this.#saving = setTimeout(() => {
      const lasting = Object.entries(this.#state).filter(([name]) => !PASSING.has(name));
      const plain = { ...Object.fromEntries(lasting), selected: [...this.#state.selected] };
      try {
        sessionStorage.setItem(KEY, JSON.stringify(plain));
      } catch {
        // storage is off or full: this page still works, a reload starts afresh
      }
    }, 200);
  }
}

export const view = new View();
