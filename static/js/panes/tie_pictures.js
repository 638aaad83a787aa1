/** Two photographs side by side, in which ties are drawn: a click in one, and a click at the same place in the other. */

import { request } from "../net/requests.js";
import { makeCanvas } from "../ui/canvas.js";
import { button, fill } from "../ui/controls.js";
import { makeDialog } from "../ui/dialog.js";
import { element, setAttribute, setChildren, setText } from "../ui/dom.js";
import { fixed } from "../ui/numbers.js";
import { readLook } from "./colors.js";
import { fitted, allowed, inside, keptInSight, moved, SMOOTH_BELOW, toPixel, toScreen, wheelFactor, zoomedAbout } from "./viewport.js";

const MARK_PX = 7;
const DRAG_PX = 4; // a press that moves less is a click
const SNAP_PX = 10; // a click so near a mark means the place that it marks
const KEY_ZOOM = 1.25;
const STEPS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
const FAST = 10; // with Shift
const SIGMA = { least: 0.1, most: 20, usual: 1 }; // px

/** @returns {string} the address of a photograph's whole picture */
const addressOf = ({ id, rev }) => `picture/photo/${encodeURIComponent(id)}?rev=${encodeURIComponent(rev ?? id)}&form=quick`;

/**
 * One of the two pictures.
 * @param {{store: import("../net/store.js").Store, name: string, placed: () => void, marks: () => {uv: number[], label: string, bad: boolean, here: boolean}[]}} options
 *   `marks`: of the ties that are kept, in this picture; `here`: the other picture shows them, too
 */
const makePicture = ({ store, name, placed, marks }) => {
  let viewport = null;
  let photo = null;
  let image = null;
  let uv = null;
  let cursor = null;
  let press = null;
  const look = readLook();

  const sign = (context, [x, y], colour, label) => {
    for (const [style, width] of [[look.halo, 4], [colour, 2]]) {
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
  const { canvas, draw } = makeCanvas({ class: "tie-picture", tabIndex: 0, role: "img", "aria-label": name }, (context, width, height) => {
    if (!image || !photo) return;
    viewport ??= fitted([width, height], [photo.width, photo.height]);
    context.imageSmoothingEnabled = viewport.zoom < SMOOTH_BELOW;
    context.drawImage(image, viewport.x, viewport.y, photo.width * viewport.zoom, photo.height * viewport.zoom);
    for (const { uv: at, label, bad, here } of marks()) sign(context, toScreen(viewport, at), bad ? look.bad : here ? look.matches[1] : look.dim, label);
    if (uv) sign(context, toScreen(viewport, uv), look.ink, "");
    if (cursor && document.activeElement === canvas) sign(context, toScreen(viewport, cursor), look.dim, "");
  });
  const size = () => [photo?.width ?? 1, photo?.height ?? 1];
  const pane = () => [canvas.clientWidth, canvas.clientHeight];
  const show = (wanted) => {
    viewport = keptInSight(wanted, pane(), size());
    draw();
  };
  const zoomBy = (factor, xy) => viewport && show(zoomedAbout(viewport, xy, allowed(viewport.zoom * factor, pane(), size())));
  /** The place near a pixel of a tie that the other picture does not show: a tie that ends there, exactly, continues it. */
  const marked = (at) => {
    const away = ({ uv: there }) => Math.hypot(there[0] - at[0], there[1] - at[1]) * viewport.zoom;
    const open = marks().filter((mark) => !mark.here && away(mark) < SNAP_PX);
    const [nearest] = open.sort((one, other) => away(one) - away(other));
    return nearest?.uv ?? null;
  };
  const place = (at) => {
    if (!photo || store.readOnly) return;
    uv = marked(at) ?? inside(at, size());
    draw();
    placed();
  };
  const positionOf = ({ offsetX, offsetY }) => [offsetX, offsetY];
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
    if (!press?.from) return;
    const by = positionOf(event).map((value, k) => value - press.at[k]);
    press.drags ||= Math.hypot(...by) > DRAG_PX;
    if (press.drags) show(moved(press.from, by));
  });
  const released = (event) => {
    const was = press;
    press = null;
    if (was?.from && !was.drags && event.type === "pointerup") place(toPixel(viewport, positionOf(event)));
  };
  canvas.addEventListener("pointerup", released);
  canvas.addEventListener("pointercancel", released);
  canvas.addEventListener("keydown", (event) => {
    const step = STEPS[event.key];
    if (!viewport || event.ctrlKey || event.metaKey || event.altKey) return;
    const middle = toPixel(viewport, pane().map((length) => length / 2));
    if (step) {
      const by = (event.shiftKey ? FAST : 1) / Math.min(1, viewport.zoom);
      cursor = inside((cursor ?? uv ?? middle).map((value, k) => value + by * step[k]), size());
      draw();
    } else if (event.key === "Enter" || event.key === " ") place(cursor ?? middle);
    else if (event.key === "+" || event.key === "=") zoomBy(KEY_ZOOM, toScreen(viewport, cursor ?? middle));
    else if (event.key === "-") zoomBy(1 / KEY_ZOOM, toScreen(viewport, cursor ?? middle));
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
    /** @param {number[] | null} end the end that is drawn; null: none */
    put(end) {
      uv = end;
      draw();
    },
    /** Show a photograph; the same one stays as it is. */
    show(wanted) {
      if (wanted?.id === photo?.id && wanted?.rev === photo?.rev) return;
      [photo, image, viewport, uv, cursor] = [wanted, null, null, null, null];
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

const SIDES = ["first", "second"];

/**
 * Mount the dialog, which opens while `view` names a photograph to draw ties from.
 * @param {{store: import("../net/store.js").Store, view: any}} page
 */
export const mountTiePictures = ({ store, view }) => {
  const chosen = { first: "", second: "" };
  const ofPair = () => (store.get("drawn_ties") ?? []).filter(({ photos }) => photos.includes(chosen.first) && photos.includes(chosen.second));
  const numberOf = (id) => id.slice(1);
  const other = { first: "second", second: "first" };
  /** Of all ties that end in a picture: one of a pair that is not shown can be continued into the other picture. */
  const marksOf = (side) => () => {
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
  const pictures = Object.fromEntries(
    SIDES.map((side) => [side, makePicture({ store, name: `${side} photograph`, placed: () => keep(), marks: marksOf(side) })]),
  );
  const selects = Object.fromEntries(SIDES.map((side) => {
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
  const { dialog, open } = makeDialog(
    "Ties drawn by hand",
    { kind: "tie-dialog" },
    element(
      "div",
      { class: "tie-pictures" },
      ...SIDES.map((side) => element("div", { class: "tie-side" }, element("div", { class: "row" }, selects[side], pictures[side].fit), pictures[side].canvas)),
    ),
    element("div", { class: "row tie-bar" }, hint, element("label", { class: "edits tie-sigma" }, "σ px", sigma)),
    list,
  );
  dialog.addEventListener("close", () => view.set({ tying: null }));

  const keep = async () => {
    const ends = SIDES.map((side) => pictures[side].uv);
    const photos = SIDES.map((side) => chosen[side]);
    if (ends.every(Boolean)) {
      SIDES.forEach((side) => pictures[side].put(null)); // at once: the next click begins another tie
      const sigma_px = Number(sigma.value) > 0 ? Number(sigma.value) : SIGMA.usual;
      const made = await request("add_tie", { photos, uv: ends, sigma_px });
      const free = SIDES.every((side, k) => !pictures[side].uv && chosen[side] === photos[k]);
      if (!made && free) SIDES.forEach((side, k) => pictures[side].put(ends[k]));
    }
    say();
  };

  const say = () => {
    const begun = pictures.first.uv ? "first" : "second";
    const end = pictures[begun].uv;
    const continued = end && marksOf(begun)().find(({ uv }) => uv[0] === end[0] && uv[1] === end[1]);
    setText(
      hint,
      store.readOnly ? "Ties are shown only: this link is read-only."
        : (store.get("photos") ?? []).length < 2 ? "Ties need two photographs: add another."
          : !end ? "Click a place in one photograph, then the same place in the other; or a mark, to continue its tie into a further photograph. Wheel: zoom; drag: move."
            : `${continued ? `Tie ${continued.label} is continued. ` : ""}Now click the same place in the ${other[begun]} photograph.`,
    );
  };

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
        on: { click: () => { [chosen.first, chosen.second] = tie.photos; show(); } },
      }, element("span", { class: "clip" }, `${called}: ${ends.join(" – ")}`)),
      element("span", { class: `clip ${tie.agrees === false ? "bad" : "dim"}`, title: said }, said),
      store.readOnly ? null : button({ label: `Remove tie ${number}`, text: "Remove", kind: "small edits", act: () => request("remove_ties", { ties: [tie.id] }) }),
    );
  };

  const show = () => {
    const photos = store.get("photos") ?? [];
    const ids = photos.map(({ id }) => id);
    if (!ids.includes(chosen.first)) chosen.first = store.shown() ?? ids[0] ?? "";
    if (!ids.includes(chosen.second) || chosen.second === chosen.first) chosen.second = ids.find((id) => id !== chosen.first) ?? "";
    for (const side of SIDES) {
      const beside = chosen[other[side]];
      fill(selects[side], photos.filter(({ id }) => id !== beside || side === "first").map(({ id, name }) => [id, name]), chosen[side]);
      pictures[side].show(photos.find(({ id }) => id === chosen[side]) ?? null);
      pictures[side].draw();
    }
    const names = new Map(photos.map(({ id, name }) => [id, name]));
    const pair = new Set(ofPair());
    const ties = store.get("drawn_ties") ?? [];
    setChildren(list, ...[...pair, ...ties.filter((tie) => !pair.has(tie))].map((tie) => row(tie, names)));
    sigma.disabled = store.readOnly;
    say();
  };
  store.watch(["drawn_ties", "photos", "people"], () => dialog.open && show());
  view.on((state, changed) => {
    if (!changed.has("tying") || state.tying === null) return;
    chosen.first = state.tying;
    chosen.second = "";
    SIDES.forEach((side) => pictures[side].put(null));
    open();
    show();
  });
};
