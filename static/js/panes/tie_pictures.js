/**
 * Photographs side by side, in which ties are drawn: a click in one, and a click at the same place in the other; or the
 * same straight edge in three or more, or in one and the scan, two clicks in each.
 */

import { ask } from "../net/connection.js";
import { request } from "../net/requests.js";
import { button, fill, press as showPressed } from "../ui/controls.js";
import { makeDialog } from "../ui/dialog.js";
import { element, setChildren, setText } from "../ui/dom.js";
import { messageOf } from "../ui/faults.js";
import { fixed } from "../ui/numbers.js";
import { ENOUGH, isInScan, lineHint, lineSaid, lineShownIn } from "./tie_lines.js";
import { makePicture } from "./tie_picture.js";
import { makeTieScan } from "./tie_scan.js";

const SIGMA = { least: 0.1, most: 20, usual: 1 }; // px

/**
 * @typedef {import("../net/store.js").Photo} Photo
 * @typedef {import("../protocol.d.ts").DrawnTie} DrawnTie
 * @typedef {import("../protocol.d.ts").DrawnLine} DrawnLine
 */

/** @param {Photo} photo @returns {import("./tie_picture.js").Shown} its picture */
const pictureOf = ({ id, rev, name, width, height, error }) => ({
  key: `${id} ${rev}`, name, width, height,
  address: error ? null : `picture/photo/${encodeURIComponent(id)}?rev=${encodeURIComponent(rev ?? id)}`,
});

/** @typedef {"first" | "second" | "third"} PhotoSide */
/** @typedef {PhotoSide | "scan"} PictureSide */
/** @type {("first" | "second")[]} */
const SIDES = ["first", "second"];
/** @type {PhotoSide[]} */
const ALL_SIDES = [...SIDES, "third"];
/** @type {PictureSide[]} */
const PICTURES = [...ALL_SIDES, "scan"];
const calledOf = (/** @type {string} */ side) => (side === "scan" ? side : `${side} photograph`);

/**
 * Mount the dialog, which opens while `view` names a photograph to draw ties from.
 * @param {{store: import("../net/store.js").Store, view: typeof import("../state/view.js").view}} page
 */
export const mountTiePictures = ({ store, view }) => {
  /** @type {Record<PhotoSide, string>} ids of photographs */
  const chosen = { first: "", second: "", third: "" };
  let lining = false;
  let line = ""; // id of the line that is drawn further; empty: none
  let awaited = ""; // id of a line that was just begun, and that the store may not have yet
  let keeping = Promise.resolve(); // one end after the other, so that quick clicks belong to one line
  let noted = ""; // what is doubtful of what was drawn last, or why it was not kept
  const lines = () => store.get("drawn_lines") ?? [];
  const lineNow = () => lines().find(({ id }) => id === line) ?? null;
  /** The sides that are shown: for lines up to three photographs, as many as there are, and the scan. @returns {PictureSide[]} */
  const shownSides = () => {
    if (!lining) return SIDES;
    const photos = ALL_SIDES.slice(0, Math.max(1, store.photos().length));
    return scan.isThere ? [...photos, "scan"] : photos;
  };
  const ofPair = () => (store.get("drawn_ties") ?? []).filter(({ photos }) => photos.includes(chosen.first) && photos.includes(chosen.second));
  /** @param {string} id */
  const numberOf = (id) => id.slice(1);
  /** @type {Record<PhotoSide, PhotoSide>} ties end in the first two */
  const other = { first: "second", second: "first", third: "first" };
  /** Of all ties that end in a picture: one of a pair that is not shown can be continued into the other. @param {PhotoSide} side */
  const marksOf = (side) => () => {
    if (lining) return [];
    const ties = store.get("drawn_ties") ?? [];
    const inOther = new Set(ties.filter(({ photos }) => photos.includes(chosen[other[side]])).map(({ track }) => track));
    const marks = new Map();
    for (const { id, track, photos, uv, agrees } of ties) {
      const at = photos.indexOf(chosen[side]);
      if (at < 0) continue;
      const key = uv[at].join(" ");
      const bad = agrees === false || Boolean(marks.get(key)?.bad);
      marks.set(key, { uv: uv[at], label: numberOf(track ?? id), bad, here: inOther.has(track) });
    }
    return [...marks.values()];
  };
  /**
   * @param {PictureSide} side
   * @param {DrawnLine} line
   * @returns {{ends: (number[] | null)[], path: number[][]} | null} it in the picture of a side; null: it is not drawn there
   */
  const endsIn = (side, { photos, uv, in_scan }) => {
    if (side === "scan") return scan.placed(in_scan);
    const at = photos.indexOf(chosen[side]);
    return at < 0 ? null : { ends: uv[at], path: uv[at] };
  };
  /** @param {PictureSide} side */
  const linesOf = (side) => () =>
    !lining ? [] : lines().flatMap((of) => {
      const found = endsIn(side, of);
      return found ? [{ ...found, id: of.id, label: numberOf(of.id), bad: of.agrees === false, selected: of.id === line }] : [];
    });
  /** @param {PictureSide} side @param {DrawnLine} of */
  const isDrawnIn = (side, of) => (side === "scan" ? isInScan(of) : of.photos.includes(chosen[side]));
  const scan = makeTieScan({ store, view, changed: () => show() });
  const pictures = Object.fromEntries(PICTURES.map((side) => [side, makePicture({
    store, name: calledOf(side), placed: () => placed(), marks: side === "scan" ? () => [] : marksOf(side), isLining: () => lining,
    lines: linesOf(side), drawn: (ends, zoom, again) => keepLine(side, ends, zoom, again), select: (id) => selectLine(id), erase: () => eraseIn(side),
  })]));
  const selects = Object.fromEntries(ALL_SIDES.map((side) => {
    const select = element("select", { class: "select small", "aria-label": `The ${side} photograph` });
    select.addEventListener("change", () => {
      chosen[side] = select.value;
      show();
    });
    return [side, select];
  }));
  selects.scan = scan.select;
  const erasers = Object.fromEntries(PICTURES.map((side) => [side, button({
    label: `Erase in the ${calledOf(side)}`, text: "Erase", kind: "small edits", title: "Remove the selected line from this picture (Delete)", act: () => eraseIn(side),
  })]));
  const sigma = element("input", { type: "number", class: "field small", min: SIGMA.least, max: SIGMA.most, step: 0.1, value: SIGMA.usual, "aria-label": "Standard deviation of each end, px" });
  const hint = element("p", { class: "dim tie-hint", role: "status" });
  const list = element("ul", { class: "tie-list", "aria-label": "Ties drawn by hand" });
  const sides = Object.fromEntries(PICTURES.map((side) => [
    side, element("div", { class: "tie-side" }, element("div", { class: "row" }, selects[side], erasers[side], pictures[side].fit), pictures[side].canvas),
  ]));
  /** @param {boolean} wanted */
  const setLining = (wanted) => {
    lining = wanted;
    line = noted = "";
    PICTURES.forEach((side) => { pictures[side].put(null); pictures[side].begin(null); });
    show();
  };
  const places = button({ label: "Places", kind: "small", title: "A tie is one place in two photographs", act: () => setLining(false) });
  const edges = button({ label: "Lines", kind: "small", title: `A line is one straight edge in ${ENOUGH} photographs or more, or in one and the scan; its ends may differ`, act: () => setLining(true) });
  const kinds = element("div", { class: "tie-kinds", role: "group", "aria-label": "What is drawn" }, places, edges);
  const another = button({ label: "New line", kind: "small edits", title: "Begin another line, also where this one is not drawn", act: () => selectLine("") });
  const all = element("div", { class: "tie-pictures" }, ...PICTURES.map((side) => sides[side]));
  const { dialog, open } = makeDialog(
    "Ties and lines drawn by hand",
    { kind: "tie-dialog" },
    all,
    element("div", { class: "row tie-bar" }, hint, another, kinds, element("label", { class: "edits tie-sigma" }, "σ px", sigma)),
    list,
  );
  dialog.addEventListener("close", () => view.set({ tying: null }));

  const keep = async () => {
    const ends = SIDES.map((side) => pictures[side].uv).filter((uv) => uv !== null);
    const photos = SIDES.map((side) => chosen[side]);
    if (ends.length === SIDES.length) {
      SIDES.forEach((side) => pictures[side].put(null)); // at once: the next click begins another tie
      const made = await request("add_tie", { photos, uv: ends, sigma_px: sigmaPx() });
      const free = SIDES.every((side, k) => !pictures[side].uv && chosen[side] === photos[k]);
      if (!made && free) SIDES.forEach((side, k) => pictures[side].put(ends[k]));
    }
    say();
  };

  const sigmaPx = () => (Number(sigma.value) > 0 ? Number(sigma.value) : SIGMA.usual);
  const placed = () => {
    noted = "";
    if (lining) say();
    else void keep();
  };
  /** @param {string} id */
  const selectLine = (id) => {
    [line, noted] = [id, ""];
    show();
  };
  /**
   * Keep two places of an edge: of a line that is drawn there `again`, or of the selected one where the picture does not
   * show that yet.
   * @param {PictureSide} side
   * @param {number[][]} ends
   * @param {number} zoom at which they were placed
   * @param {string | null} again
   */
  const keepLine = (side, ends, zoom, again) => {
    const photo = side === "scan" ? "" : chosen[side], sigma_px = sigmaPx();
    const inScan = side === "scan" ? scan.sent(ends, zoom) : null;
    keeping = keeping.then(async () => {
      const now = lineNow();
      const further = again ?? (line && !(now && isDrawnIn(side, now)) ? line : null);
      try {
        const made = inScan
          ? await ask("draw_line_in_scan", { ...inScan, line: further, sigma_px })
          : await ask("draw_line", { photo, uv: ends, line: further, sigma_px });
        awaited = made.line;
        selectLine(made.line);
        noted = (made.notes ?? []).join(" ");
      } catch (error) {
        noted = messageOf(error);
        const still = inScan ? scan.station === inScan.station : side === "scan" || chosen[side] === photo;
        if (!again && still && !pictures[side].begun) pictures[side].begin(ends[0]);
      }
      pictures[side].draw();
      say();
    });
  };
  /** Remove the selected line from a picture. @param {PictureSide} side */
  const eraseIn = (side) => {
    const now = lineNow();
    if (store.readOnly || !now || !isDrawnIn(side, now)) return;
    void request("erase_line", { line: now.id, photo: side === "scan" ? null : chosen[side] });
  };

  const say = () => {
    hint.classList.toggle("warn", Boolean(noted));
    if (lining) {
      const begun = PICTURES.find((side) => pictures[side].begun) ?? null;
      const total = store.photos().length, called = begun && calledOf(begun);
      const next = lineHint({ readOnly: store.readOnly, photos: total, hasScan: scan.isThere, begun: called, line: lineNow(), number: numberOf(line) });
      setText(hint, noted || next);
      return;
    }
    const begun = pictures.first.uv ? "first" : "second";
    const end = pictures[begun].uv;
    const continued = end && marksOf(begun)().find(({ uv }) => uv[0] === end[0] && uv[1] === end[1]);
    setText(
      hint,
      store.readOnly ? "Ties are shown only: this link is read-only."
        : store.photos().length < 2 ? "Ties need two photographs: add another."
          : !end ? "Click a place in one photograph, then the same place in the other; or a mark, to continue its tie into a further photograph. Wheel: zoom; drag: move."
            : `${continued ? `Tie ${continued.label} is continued. ` : ""}Now click the same place in the ${other[begun]} photograph.`,
    );
  };

  /** @param {DrawnTie} tie @param {Map<string, string>} names */
  const row = (tie, names) => {
    const number = numberOf(tie.id), of = numberOf(tie.track ?? tie.id);
    const called = of === number ? number : `${number}, with ${of}`;
    const ends = tie.photos.map((id, k) => `${names.get(id) ?? id} (${tie.uv[k].map((value) => fixed(value, 1)).join(", ")})`);
    const said = tie.agrees === null ? "not adjusted yet" : tie.reason;
    return element(
      "li",
      { class: "tie-row" },
      element("button", {
        type: "button", class: "survey-name", title: "Show its two photographs",
        on: { click: () => { if (lining) setLining(false); [chosen.first, chosen.second] = tie.photos; show(); } },
      }, element("span", { class: "clip" }, `Tie ${called}: ${ends.join(" – ")}`)),
      element("span", { class: `clip ${tie.agrees === false ? "bad" : "dim"}`, title: said }, said),
      store.readOnly ? null : button({ label: `Remove tie ${number}`, text: "Remove", kind: "small edits", act: () => request("remove_ties", { ties: [tie.id] }) }),
    );
  };

  /** @param {DrawnLine} of */
  const showLine = (of) => {
    [line, noted] = [of.id, ""];
    if (of.in_scan) scan.reveal(of.in_scan);
    const free = store.photos().map(({ id }) => id).filter((id) => !of.photos.includes(id));
    [chosen.first, chosen.second, chosen.third] = [...of.photos, ...free];
    show();
  };
  /** @param {DrawnLine} of @param {Map<string, string>} names */
  const lineRow = (of, names) => {
    const number = numberOf(of.id), said = lineSaid(of);
    const pair = of.photos.length === SIDES.length && !of.in_scan;
    return element(
      "li",
      { class: "tie-row" },
      element("button", {
        type: "button", class: "survey-name", title: "Show its photographs, and draw it in further ones", "aria-pressed": String(of.id === line),
        on: { click: () => { if (!lining) setLining(true); showLine(of); } },
      }, element("span", { class: "clip" }, `Line ${number}: ${lineShownIn(of, names)}`)),
      element("span", { class: `clip ${of.agrees === false ? "bad" : "dim"}`, title: said }, said),
      store.readOnly ? null : element(
        "div",
        { class: "row" },
        pair ? button({
          label: `Keep the ends of line ${number} as ties`, text: "Ends as ties", kind: "small edits", act: () => request("line_ends_as_ties", { line: of.id }),
          title: "If both photographs show the same two ends of the edge: two ties of these, in the order in which they were clicked",
        }) : null,
        button({ label: `Remove line ${number}`, text: "Remove", kind: "small edits", act: () => request("remove_lines", { lines: [of.id] }) }),
      ),
    );
  };

  const show = () => {
    const photos = store.photos();
    const ids = photos.map(({ id }) => id), taken = new Set();
    if (lineNow()) awaited = "";
    else if (line !== awaited) line = "";
    if (!ids.includes(chosen.first)) chosen.first = store.shown() ?? ids[0] ?? "";
    const visible = shownSides(), now = lineNow();
    all.dataset.pictures = String(visible.length);
    for (const side of PICTURES) {
      sides[side].hidden = !visible.includes(side);
      erasers[side].hidden = !(lining && now && isDrawnIn(side, now));
    }
    pictures.scan.show(sides.scan.hidden ? null : scan.shown());
    pictures.scan.draw();
    for (const side of ALL_SIDES) {
      if (!ids.includes(chosen[side]) || taken.has(chosen[side])) chosen[side] = ids.find((id) => !taken.has(id)) ?? "";
      fill(selects[side], photos.filter(({ id }) => !taken.has(id)).map(({ id, name }) => [id, name]), chosen[side]);
      taken.add(chosen[side]);
      const photo = photos.find(({ id }) => id === chosen[side]);
      pictures[side].show(sides[side].hidden || !photo ? null : pictureOf(photo));
      pictures[side].draw();
    }
    showPressed(places, !lining);
    showPressed(edges, lining);
    another.hidden = !lining || !line;
    const names = new Map(photos.map(({ id, name }) => [id, name]));
    const pair = new Set(ofPair());
    const ties = store.get("drawn_ties") ?? [];
    const rows = [...pair, ...ties.filter((tie) => !pair.has(tie))].map((tie) => row(tie, names));
    const lineRows = lines().map((of) => lineRow(of, names));
    setChildren(list, ...(lining ? [...lineRows, ...rows] : [...rows, ...lineRows]));
    sigma.disabled = store.readOnly;
    say();
  };
  store.watch(["drawn_ties", "drawn_lines", "photos", "people", "scan", "beside", "partner", "stations"], () => dialog.open && show());
  view.on((state, changed) => {
    if (!changed.has("tying") || state.tying === null) return;
    chosen.first = state.tying;
    chosen.second = "";
    chosen.third = "";
    scan.follow();
    open();
    setLining(lining || store.photos().length < SIDES.length);
  });
};
