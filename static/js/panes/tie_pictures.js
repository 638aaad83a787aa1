/**
 * Photographs side by side, in which ties are drawn: a click in one, and a click at the same place in the other; or the
 * same straight edge in three or more, two clicks in each.
 */

import { request } from "../net/requests.js";
import { makeCanvas } from "../ui/canvas.js";
import { button, fill, press as showPressed } from "../ui/controls.js";
import { makeDialog } from "../ui/dialog.js";
import { element, setAttribute, setChildren, setText } from "../ui/dom.js";
import { fixed } from "../ui/numbers.js";
import { readLook } from "./colors.js";
import { ENOUGH, lineHint, lineSaid, lineShownIn } from "./tie_lines.js";
import { fitted, allowed, inside, keptInSight, moved, SMOOTH_BELOW, toPixel, toScreen, wheelFactor, zoomedAbout } from "./viewport.js";

/**
 * @typedef {import("./viewport.js").Viewport} Viewport
 * @typedef {import("../net/store.js").Photo} Photo
 * @typedef {import("../protocol.d.ts").DrawnTie} DrawnTie
 * @typedef {import("../protocol.d.ts").DrawnLine} DrawnLine
 */

const MARK_PX = 7;
const DRAG_PX = 4; // a press that moves less is a click
const SNAP_PX = 10; // a click so near a mark means the place that it marks
const KEY_ZOOM = 1.25;
/** @type {Partial<Record<string, readonly [number, number]>>} */
const STEPS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
const FAST = 10; // with Shift
const LEAST_LINE_PX = 5; // as the server: a shorter line has no direction, and a second click so near is a mistake
const MIDDLE = [0.2, 0.8]; // part of a line that a click selects; at its ends, other edges begin
const SIGMA = { least: 0.1, most: 20, usual: 1 }; // px

/** @param {Photo} photo @returns {string} the address of a photograph's whole picture */
const addressOf = ({ id, rev }) => `picture/photo/${encodeURIComponent(id)}?rev=${encodeURIComponent(rev ?? id)}&form=quick`;

/**
 * One of the pictures.
 * @param {{store: import("../net/store.js").Store, name: string, placed: () => void,
 *   marks: () => {uv: number[], label: string, bad: boolean, here: boolean}[], isLining: () => boolean,
 *   lines: () => {id: string, ends: number[][], label: string, bad: boolean, selected: boolean}[],
 *   drawn: (ends: number[][]) => void, select: (id: string) => void}} options
 *   `marks`: of the ties that are kept, in this picture; `here`: the other picture shows them, too; `lines`: likewise the
 *   lines; `drawn`: both ends of a further one are placed
 */
const makePicture = ({ store, name, placed, marks, isLining, lines, drawn, select }) => {
  /** @type {Viewport | null} */
  let viewport = null;
  /** @type {Photo | null} */
  let photo = null;
  /** @type {HTMLImageElement | null} */
  let image = null;
  /** @type {number[] | null} */
  let uv = null;
  /** @type {number[] | null} the first end of a line */
  let begun = null;
  /** @type {number[] | null} where the pointer is meanwhile */
  let toward = null;
  /** @type {number[] | null} */
  let cursor = null;
  /** @type {{at: number[], drags: boolean, from: Viewport | null} | null} */
  let press = null;
  const look = readLook();

  /** @param {CanvasRenderingContext2D} context @param {readonly number[]} at @param {string} colour @param {string} label */
  const sign = (context, [x, y], colour, label) => {
    for (const [style, width] of /** @type {[string, number][]} */ ([[look.halo, 4], [colour, 2]])) {
      context.strokeStyle = style;
      context.lineWidth = width;
      context.beginPath();
      context.moveTo(x - MARK_PX, y);
      context.lineTo(x + MARK_PX, y);
      context.moveTo(x, y - MARK_PX);
      context.lineTo(x, y + MARK_PX);
      context.stroke();
    }
    if (!label) return;
    context.font = look.font;
    context.lineWidth = 3;
    context.strokeStyle = look.halo;
    context.strokeText(label, x + MARK_PX, y - MARK_PX);
    context.fillStyle = colour;
    context.fillText(label, x + MARK_PX, y - MARK_PX);
  };
  /** @param {CanvasRenderingContext2D} context @param {(readonly number[])[]} ends in the pane @param {string} colour @param {string} label */
  const stroke = (context, ends, colour, label, bold = false) => {
    const [from, to] = ends;
    for (const [style, width] of /** @type {[string, number][]} */ ([[look.halo, bold ? 6 : 4], [colour, bold ? 3 : 2]])) {
      context.strokeStyle = style;
      context.lineWidth = width;
      context.beginPath();
      context.moveTo(from[0], from[1]);
      context.lineTo(to[0], to[1]);
      context.stroke();
    }
    for (const end of [from, to]) sign(context, end, colour, "");
    if (label) sign(context, from, colour, label);
  };
  const { canvas, draw } = makeCanvas({ class: "tie-picture", tabIndex: 0, role: "img", "aria-label": name }, (context, width, height) => {
    if (!image || !photo) return;
    const now = viewport ??= fitted([width, height], [photo.width, photo.height]);
    const on = (/** @type {readonly number[]} */ at) => toScreen(now, at);
    context.imageSmoothingEnabled = now.zoom < SMOOTH_BELOW;
    context.drawImage(image, now.x, now.y, photo.width * now.zoom, photo.height * now.zoom);
    for (const { uv: at, label, bad, here } of marks()) sign(context, on(at), bad ? look.bad : here ? look.matches[1] : look.dim, label);
    for (const { ends, label, bad, selected } of lines()) stroke(context, ends.map(on), selected ? look.ink : bad ? look.bad : look.matches[1], label, selected);
    if (begun) stroke(context, [begun, toward ?? cursor ?? begun].map(on), look.ink, "");
    if (uv) sign(context, on(uv), look.ink, "");
    if (cursor && document.activeElement === canvas) sign(context, on(cursor), look.dim, "");
  });
  const size = () => [photo?.width ?? 1, photo?.height ?? 1];
  const pane = () => [canvas.clientWidth, canvas.clientHeight];
  /** @param {Viewport} wanted */
  const show = (wanted) => {
    viewport = keptInSight(wanted, pane(), size());
    draw();
  };
  const zoomNow = () => viewport?.zoom ?? 1;
  /** @param {number} factor @param {readonly number[]} xy */
  const zoomBy = (factor, xy) => viewport && show(zoomedAbout(viewport, xy, allowed(viewport.zoom * factor, pane(), size())));
  /** The place near a pixel of a tie that the other picture does not show: a tie that ends there continues it. @param {readonly number[]} at */
  const marked = (at) => {
    const away = (/** @type {{uv: number[]}} */ { uv: there }) => Math.hypot(there[0] - at[0], there[1] - at[1]) * zoomNow();
    const open = marks().filter((mark) => !mark.here && away(mark) < SNAP_PX);
    const [nearest] = open.sort((one, other) => away(one) - away(other));
    return nearest?.uv ?? null;
  };
  /** The line near a pixel, not near its ends. @param {readonly number[]} at */
  const lineAt = (at) => {
    /** @param {{ends: number[][]}} line */
    const away = ({ ends: [from, to] }) => {
      const along = [to[0] - from[0], to[1] - from[1]], length = Math.hypot(...along) || 1;
      const by = [at[0] - from[0], at[1] - from[1]], share = (by[0] * along[0] + by[1] * along[1]) / length ** 2;
      const off = Math.abs(by[0] * along[1] - by[1] * along[0]) / length;
      return share > MIDDLE[0] && share < MIDDLE[1] ? off * zoomNow() : Infinity;
    };
    const near = lines().filter((line) => !line.selected && away(line) < MARK_PX);
    return near.sort((one, other) => away(one) - away(other))[0] ?? null;
  };
  /** @param {number[]} at */
  const placeEnd = (at) => {
    const near = begun ? null : lineAt(at);
    if (near) select(near.id);
    else if (!begun) [begun, toward] = [at, null];
    else if (Math.hypot(at[0] - begun[0], at[1] - begun[1]) >= LEAST_LINE_PX) {
      const ends = [begun, at];
      begun = null;
      drawn(ends);
    }
    draw();
    placed();
  };
  /** @param {readonly number[]} at */
  const place = (at) => {
    if (!photo || store.readOnly) return;
    if (isLining()) {
      placeEnd(inside(at, size()));
      return;
    }
    uv = marked(at) ?? inside(at, size());
    draw();
    placed();
  };
  const forget = () => {
    begun = toward = null;
    draw();
    placed();
  };
  const positionOf = (/** @type {MouseEvent} */ { offsetX, offsetY }) => [offsetX, offsetY];
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoomBy(wheelFactor(event), positionOf(event));
  }, { passive: false });
  canvas.addEventListener("pointerdown", (event) => {
    if (event.button > 1) return;
    canvas.setPointerCapture(event.pointerId);
    press = { at: positionOf(event), drags: event.button === 1, from: viewport };
  });
  canvas.addEventListener("pointermove", (event) => {
    if (begun && viewport) {
      toward = toPixel(viewport, positionOf(event));
      draw();
    }
    if (!press?.from) return;
    const [left, top] = positionOf(event);
    const by = [left - press.at[0], top - press.at[1]];
    press.drags ||= Math.hypot(...by) > DRAG_PX;
    if (press.drags) show(moved(press.from, by));
  });
  /** @param {PointerEvent} event */
  const released = (event) => {
    const was = press;
    press = null;
    if (viewport && was?.from && !was.drags && event.type === "pointerup") place(toPixel(viewport, positionOf(event)));
  };
  canvas.addEventListener("pointerup", released);
  canvas.addEventListener("pointercancel", released);
  canvas.addEventListener("keydown", (event) => {
    const step = STEPS[event.key];
    if (!viewport || event.ctrlKey || event.metaKey || event.altKey) return;
    const middle = toPixel(viewport, pane().map((length) => length / 2));
    if (step) {
      const by = (event.shiftKey ? FAST : 1) / Math.min(1, viewport.zoom);
      toward = null;
      cursor = inside((cursor ?? uv ?? middle).map((value, k) => value + by * step[k]), size());
      draw();
    } else if (event.key === "Enter" || event.key === " ") place(cursor ?? middle);
    else if (event.key === "+" || event.key === "=") zoomBy(KEY_ZOOM, toScreen(viewport, cursor ?? middle));
    else if (event.key === "-") zoomBy(1 / KEY_ZOOM, toScreen(viewport, cursor ?? middle));
    else if ((event.key === "Backspace" || event.key === "Delete") && begun) forget();
    else if (event.key === "0") show(fitted(pane(), size()));
    else return;
    event.preventDefault();
    event.stopPropagation();
  });
  for (const kind of ["focus", "blur"]) canvas.addEventListener(kind, draw);
  const fit = button({ label: `Fit the ${name}`, text: "Fit", title: "Fit the whole picture (0)", kind: "small", act: () => photo && show(fitted(pane(), size())) });
  return {
    canvas,
    fit,
    draw,
    get uv() {
      return uv;
    },
    get begun() {
      return begun;
    },
    /** @param {number[] | null} end the first end of a line; null: none */
    begin(end) {
      [begun, toward] = [end, null];
      draw();
    },
    /** @param {number[] | null} end the end that is drawn; null: none */
    put(end) {
      uv = end;
      draw();
    },
    /** Show a photograph; the same one stays as it is. */
    show(/** @type {Photo | null} */ wanted) {
      if (wanted?.id === photo?.id && wanted?.rev === photo?.rev) return;
      [photo, image, viewport, uv, cursor, begun, toward] = [wanted, null, null, null, null, null, null];
      setAttribute(canvas, "aria-label", wanted ? `${name}: ${wanted.name}` : name);
      draw();
      if (!wanted || wanted.error) return;
      const loaded = new Image();
      loaded.addEventListener("load", () => {
        if (photo !== wanted) return;
        image = loaded;
        draw();
      });
      loaded.src = addressOf(wanted);
    },
  };
};

/** @typedef {"first" | "second" | "third"} PictureSide */
/** @type {("first" | "second")[]} */
const SIDES = ["first", "second"];
/** @type {PictureSide[]} */
const ALL_SIDES = [...SIDES, "third"];

/**
 * Mount the dialog, which opens while `view` names a photograph to draw ties from.
 * @param {{store: import("../net/store.js").Store, view: typeof import("../state/view.js").view}} page
 */
export const mountTiePictures = ({ store, view }) => {
  /** @type {Record<PictureSide, string>} ids of photographs */
  const chosen = { first: "", second: "", third: "" };
  let lining = false;
  let line = ""; // id of the line that is drawn further; empty: none
  let awaited = ""; // id of a line that was just begun, and that the store may not have yet
  let keeping = Promise.resolve(); // one end after the other, so that quick clicks belong to one line
  const lines = () => store.get("drawn_lines") ?? [];
  const lineNow = () => lines().find(({ id }) => id === line) ?? null;
  /** The sides that are shown: three for lines, if there are so many photographs. */
  const shownSides = () => (lining && store.photos().length > SIDES.length ? ALL_SIDES : SIDES);
  const ofPair = () => (store.get("drawn_ties") ?? []).filter(({ photos }) => photos.includes(chosen.first) && photos.includes(chosen.second));
  /** @param {string} id */
  const numberOf = (id) => id.slice(1);
  /** @type {Record<PictureSide, PictureSide>} ties end in the first two */
  const other = { first: "second", second: "first", third: "first" };
  /** Of all ties that end in a picture: one of a pair that is not shown can be continued into the other. @param {PictureSide} side */
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
  /** @param {PictureSide} side */
  const linesOf = (side) => () =>
    !lining ? [] : lines().filter(({ photos }) => photos.includes(chosen[side])).map(({ id, photos, uv, agrees }) => (
      { id, ends: uv[photos.indexOf(chosen[side])], label: numberOf(id), bad: agrees === false, selected: id === line }
    ));
  const pictures = Object.fromEntries(ALL_SIDES.map((side) => [side, makePicture({
    store, name: `${side} photograph`, placed: () => (lining ? say() : keep()), marks: marksOf(side), isLining: () => lining,
    lines: linesOf(side), drawn: (ends) => keepLine(side, ends), select: (id) => selectLine(id),
  })]));
  const selects = Object.fromEntries(ALL_SIDES.map((side) => {
    const select = element("select", { class: "select small", "aria-label": `The ${side} photograph` });
    select.addEventListener("change", () => {
      chosen[side] = select.value;
      show();
    });
    return [side, select];
  }));
  const sigma = element("input", { type: "number", class: "field small", min: SIGMA.least, max: SIGMA.most, step: 0.1, value: SIGMA.usual, "aria-label": "Standard deviation of each end, px" });
  const hint = element("p", { class: "dim tie-hint", role: "status" });
  const list = element("ul", { class: "tie-list", "aria-label": "Ties drawn by hand" });
  const sides = Object.fromEntries(ALL_SIDES.map((side) => [
    side, element("div", { class: "tie-side" }, element("div", { class: "row" }, selects[side], pictures[side].fit), pictures[side].canvas),
  ]));
  /** @param {boolean} wanted */
  const setLining = (wanted) => {
    lining = wanted;
    line = "";
    ALL_SIDES.forEach((side) => { pictures[side].put(null); pictures[side].begin(null); });
    show();
  };
  const places = button({ label: "Places", kind: "small", title: "A tie is one place in two photographs", act: () => setLining(false) });
  const edges = button({ label: "Lines", kind: "small", title: `A line is one straight edge in ${ENOUGH} photographs or more; its ends may differ`, act: () => setLining(true) });
  const kinds = element("div", { class: "tie-kinds", role: "group", "aria-label": "What is drawn" }, places, edges);
  const another = button({ label: "New line", kind: "small edits", title: "Begin another line, also where this one is not drawn", act: () => selectLine("") });
  const { dialog, open } = makeDialog(
    "Ties drawn by hand",
    { kind: "tie-dialog" },
    element(
      "div",
      { class: "tie-pictures" },
      ...ALL_SIDES.map((side) => sides[side]),
    ),
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
  /** @param {string} id */
  const selectLine = (id) => {
    line = id;
    show();
  };
  /**
   * Keep two places of an edge, of the selected line where the photograph does not show that yet.
   * @param {PictureSide} side
   * @param {number[][]} ends
   */
  const keepLine = (side, ends) => {
    const photo = chosen[side], sigma_px = sigmaPx();
    keeping = keeping.then(async () => {
      const further = line && !lineNow()?.photos.includes(photo) ? line : null;
      const made = await request("draw_line", { photo, uv: ends, line: further, sigma_px });
      if (made) {
        awaited = made.line;
        selectLine(made.line);
      } else if (chosen[side] === photo && !pictures[side].begun) pictures[side].begin(ends[0]);
      say();
    });
  };

  const say = () => {
    if (lining) {
      const begun = ALL_SIDES.find((side) => pictures[side].begun) ?? null;
      const total = store.photos().length;
      setText(hint, lineHint({ readOnly: store.readOnly, photos: total, begun, line: lineNow(), number: numberOf(line) }));
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
    line = of.id;
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
    for (const side of ALL_SIDES) {
      sides[side].hidden = !shownSides().includes(side);
      if (!ids.includes(chosen[side]) || taken.has(chosen[side])) chosen[side] = ids.find((id) => !taken.has(id)) ?? "";
      fill(selects[side], photos.filter(({ id }) => !taken.has(id)).map(({ id, name }) => [id, name]), chosen[side]);
      taken.add(chosen[side]);
      pictures[side].show(sides[side].hidden ? null : photos.find(({ id }) => id === chosen[side]) ?? null);
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
  store.watch(["drawn_ties", "drawn_lines", "photos", "people"], () => dialog.open && show());
  view.on((state, changed) => {
    if (!changed.has("tying") || state.tying === null) return;
    chosen.first = state.tying;
    chosen.second = "";
    chosen.third = "";
    open();
    setLining(lining);
  });
};
