/** One of the pictures of the dialog in which ties and lines are drawn: zoom, clicks, keys, and what is drawn over it. */

import { makeCanvas } from "../ui/canvas.js";
import { button } from "../ui/controls.js";
import { setAttribute } from "../ui/dom.js";
import { readLook } from "./colors.js";
import { fitted, allowed, inside, keptInSight, moved, SMOOTH_BELOW, toPixel, toScreen, wheelFactor, zoomedAbout } from "./viewport.js";

const MARK_PX = 7;
const LABEL_PX = 13;
/** @type {Viewport} before the picture is there */
const UNSEEN = { zoom: 1, x: 0, y: 0 };
const DRAG_PX = 4; // a press that moves less is a click
const SNAP_PX = 10; // a click so near a mark means the place that it marks
const KEY_ZOOM = 1.25;
/** @type {Partial<Record<string, readonly [number, number]>>} */
const STEPS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
const FAST = 10; // with Shift
const MIN_LINE_PX = 5; // as the server: a shorter line has no direction, and a second click so near is a mistake
const MIDDLE = [0.2, 0.8]; // part of a line that a click selects; at its ends, other edges begin

/**
 * @typedef {import("./viewport.js").Viewport} Viewport
 * @typedef {{id: string, index: number, ends: number[][]}} EndMoved the end of a line that is being moved
 * @typedef {{key: string, name: string, width: number, height: number, address: string | null}} Shown a picture: `key`
 *   identifies what it shows, `address` is that of the exact one, null: there is none
 * @typedef {{id: string, ends: (number[] | null)[], path: number[][], label: string, bad: boolean, selected: boolean}} LineHere
 *   a line in this picture: the pixels of its ends, null outside of the view, and those between which it is drawn
 */

/**
 * @param {{store: import("../net/store.js").Store, name: string, placed: () => void,
 *   marks: () => {uv: number[], label: string, bad: boolean, here: boolean}[], isLining: () => boolean,
 *   lines: () => LineHere[], drawn: (ends: number[][], zoom: number, again: string | null) => void,
 *   select: (id: string) => void, erase: () => void}} options
 *   `marks`: of the ties that are kept, in this picture; `here`: the other picture shows them, too; `lines`: likewise the
 *   lines; `drawn`: both ends are placed, of a further one or of one that is moved; `erase` the selected one here
 */
export const makePicture = ({ store, name, placed, marks, isLining, lines, drawn, select, erase }) => {
  /** @type {Viewport | null} */
  let viewport = null;
  let whole = true; // all of the picture is shown, until one zooms or moves it
  /** @type {Shown | null} */
  let photo = null;
  /** @type {HTMLImageElement | null} */
  let image = null;
  let exact = false; // the exact picture is loaded, or being loaded
  /** @type {number[] | null} */
  let uv = null;
  /** @type {number[] | null} the first end of a line */
  let begun = null;
  /** @type {number[] | null} where the pointer is meanwhile */
  let toward = null;
  /** @type {number[] | null} */
  let cursor = null;
  /** @type {{at: number[], drags: boolean, from: Viewport | null, end: EndMoved | null} | null} */
  let press = null;
  const look = readLook();
  const now = () => viewport ?? UNSEEN;

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
    const above = Math.max(y - MARK_PX, LABEL_PX); // in sight, also at the upper border
    context.lineWidth = 3;
    context.strokeStyle = look.halo;
    context.strokeText(label, x + MARK_PX, above);
    context.fillStyle = colour;
    context.fillText(label, x + MARK_PX, above);
  };
  /**
   * @param {CanvasRenderingContext2D} context
   * @param {number[][]} path pixels between which it is drawn
   * @param {string} colour
   * @param {string} label
   * @param {(number[] | null)[]} ends
   */
  const stroke = (context, path, colour, label, bold = false, ends = path) => {
    const [from, to] = path.map((end) => toScreen(now(), end));
    for (const [style, width] of /** @type {[string, number][]} */ ([[look.halo, bold ? 6 : 4], [colour, bold ? 3 : 2]])) {
      context.strokeStyle = style;
      context.lineWidth = width;
      context.beginPath();
      context.moveTo(...from);
      context.lineTo(...to);
      context.stroke();
    }
    for (const end of ends) if (end) sign(context, toScreen(now(), end), colour, "");
    if (label) sign(context, from, colour, label);
  };
  const { canvas, draw } = makeCanvas({ class: "tie-picture", tabIndex: 0, role: "img", "aria-label": name }, (context, width, height) => {
    if (!image || !photo) return;
    if (whole) viewport = fitted([width, height], [photo.width, photo.height]); // the list below takes room when it grows
    context.imageSmoothingEnabled = now().zoom < SMOOTH_BELOW;
    context.drawImage(image, now().x, now().y, photo.width * now().zoom, photo.height * now().zoom);
    for (const { uv: at, label, bad, here } of marks()) sign(context, toScreen(now(), at), bad ? look.bad : here ? look.matches[1] : look.dim, label);
    context.save();
    context.beginPath(); // a view of the scan shows a part of a line, or none
    context.rect(now().x, now().y, photo.width * now().zoom, photo.height * now().zoom);
    context.clip();
    for (const line of lines()) {
      if (press?.end && line.id === press.end.id) continue;
      const { label, bad, selected } = line;
      stroke(context, line.path, selected ? look.ink : bad ? look.bad : look.matches[1], label, selected, line.ends);
    }
    context.restore();
    if (press?.end) stroke(context, press.end.ends, look.ink, "", true);
    if (begun) stroke(context, [begun, toward ?? cursor ?? begun], look.ink, "");
    if (uv) sign(context, toScreen(now(), uv), look.ink, "");
    if (cursor && document.activeElement === canvas) sign(context, toScreen(now(), cursor), look.dim, "");
  });
  const size = () => [photo?.width ?? 1, photo?.height ?? 1];
  const pane = () => [canvas.clientWidth, canvas.clientHeight];
  /** @param {Viewport} wanted */
  const show = (wanted) => {
    viewport = keptInSight(wanted, pane(), size());
    whole = false;
    draw();
    if (!exact && image && photo && viewport.zoom * devicePixelRatio > image.naturalWidth / photo.width) load(photo, true);
  };
  /** Load the picture; the exact one where it is shown larger than the quick one is. @param {Shown} wanted @param {boolean} whole */
  const load = (wanted, whole) => {
    exact = whole;
    const loaded = new Image();
    loaded.addEventListener("load", () => {
      if (photo !== wanted) return;
      image = loaded;
      draw();
    });
    loaded.src = whole ? wanted.address ?? "" : `${wanted.address}&form=quick`;
  };
  const fit = () => {
    whole = true;
    draw();
  };
  /** @param {number} factor @param {readonly number[]} xy */
  const zoomBy = (factor, xy) => viewport && show(zoomedAbout(viewport, xy, allowed(viewport.zoom * factor, pane(), size())));
  /** The place near a pixel of a tie that the other picture does not show: a tie that ends there continues it. @param {readonly number[]} at */
  const marked = (at) => {
    const away = (/** @type {{uv: number[]}} */ { uv: there }) => Math.hypot(there[0] - at[0], there[1] - at[1]) * now().zoom;
    const open = marks().filter((mark) => !mark.here && away(mark) < SNAP_PX);
    const [nearest] = open.sort((one, other) => away(one) - away(other));
    return nearest?.uv ?? null;
  };
  /** The line near a pixel, not near its ends. @param {readonly number[]} at */
  const lineAt = (at) => {
    const away = (/** @type {LineHere} */ { path: [from, to] }) => {
      const along = [to[0] - from[0], to[1] - from[1]], length = Math.hypot(...along) || 1;
      const by = [at[0] - from[0], at[1] - from[1]], share = (by[0] * along[0] + by[1] * along[1]) / length ** 2;
      const off = Math.abs(by[0] * along[1] - by[1] * along[0]) / length;
      return share > MIDDLE[0] && share < MIDDLE[1] ? off * now().zoom : Infinity;
    };
    const near = lines().filter((line) => !line.selected && away(line) < MARK_PX);
    return near.sort((one, other) => away(one) - away(other))[0] ?? null;
  };
  /** @param {number[]} at */
  const placeEnd = (at) => {
    const near = begun ? null : lineAt(at);
    if (near) select(near.id);
    else if (!begun) [begun, toward] = [at, null];
    else if (Math.hypot(at[0] - begun[0], at[1] - begun[1]) >= MIN_LINE_PX) {
      const ends = [begun, at];
      begun = null;
      drawn(ends, now().zoom, null);
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
  /** The end of the selected line near a position, which a press moves; null: none. @param {readonly number[]} xy */
  const endAt = (xy) => {
    const line = isLining() && !begun && !store.readOnly ? lines().find(({ selected }) => selected) : null;
    const [from, to] = line?.ends ?? [null, null];
    if (!line || !from || !to) return null;
    const away = [from, to].map((end) => Math.hypot(...toScreen(now(), end).map((value, k) => value - xy[k])));
    const index = away[0] <= away[1] ? 0 : 1;
    return away[index] < SNAP_PX ? { id: line.id, index, ends: [from, to] } : null;
  };
  const positionOf = (/** @type {MouseEvent} */ { offsetX, offsetY }) => [offsetX, offsetY];
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoomBy(wheelFactor(event), positionOf(event));
  }, { passive: false });
  canvas.addEventListener("pointerdown", (event) => {
    if (event.button > 1) return;
    canvas.setPointerCapture(event.pointerId);
    const at = positionOf(event);
    press = { at, drags: event.button === 1, from: viewport, end: event.button === 0 && viewport ? endAt(at) : null };
  });
  canvas.addEventListener("pointermove", (event) => {
    if (begun && viewport) {
      toward = toPixel(now(), positionOf(event));
      draw();
    }
    if (!press?.from) return;
    const [left, top] = positionOf(event);
    const by = [left - press.at[0], top - press.at[1]], { end: moving } = press;
    press.drags ||= Math.hypot(...by) > DRAG_PX;
    if (press.drags && moving) {
      moving.ends = moving.ends.map((end, k) => (k === moving.index ? inside(toPixel(now(), [left, top]), size()) : end));
      draw();
    } else if (press.drags) show(moved(press.from, by));
  });
  /** @param {PointerEvent} event */
  const released = (event) => {
    const was = press;
    press = null;
    if (was?.from && event.type === "pointerup") {
      if (!was.drags) place(toPixel(now(), positionOf(event)));
      else if (was.end) drawn(was.end.ends, now().zoom, was.end.id);
    }
    draw();
  };
  canvas.addEventListener("pointerup", released);
  canvas.addEventListener("pointercancel", released);
  canvas.addEventListener("keydown", (event) => {
    const step = STEPS[event.key];
    if (!viewport || event.ctrlKey || event.metaKey || event.altKey) return;
    const middle = toPixel(now(), pane().map((length) => length / 2));
    if (step) {
      const by = (event.shiftKey ? FAST : 1) / Math.min(1, viewport.zoom);
      toward = null;
      cursor = inside((cursor ?? uv ?? middle).map((value, k) => value + by * step[k]), size());
      draw();
    } else if (event.key === "Enter" || event.key === " ") place(cursor ?? middle);
    else if (event.key === "+" || event.key === "=") zoomBy(KEY_ZOOM, toScreen(now(), cursor ?? middle));
    else if (event.key === "-") zoomBy(1 / KEY_ZOOM, toScreen(now(), cursor ?? middle));
    else if ((event.key === "Backspace" || event.key === "Delete") && begun) forget();
    else if (event.key === "Delete" && isLining()) erase();
    else if (event.key === "0") fit();
    else return;
    event.preventDefault();
    event.stopPropagation();
  });
  for (const kind of ["focus", "blur"]) canvas.addEventListener(kind, draw);
  return {
    canvas,
    fit: button({ label: `Fit the ${name}`, text: "Fit", title: "Fit the whole picture (0)", kind: "small", act: () => fit() }),
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
    /** Show a picture; the same one stays as it is. @param {Shown | null} wanted */
    show(wanted) {
      if (wanted?.key === photo?.key) return;
      [photo, image, viewport, uv, cursor, begun, toward] = [wanted, null, null, null, null, null, null];
      whole = true;
      setAttribute(canvas, "aria-label", wanted ? `${name}: ${wanted.name}` : name);
      draw();
      if (wanted?.address) load(wanted, false);
    },
  };
};

