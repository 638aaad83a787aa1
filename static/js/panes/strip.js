/**
 * The overview strip above the scan's pane, for scans that no single view shows: the full turn with the field that the
 * pane shows, the outline of each photograph, and a shade where none looks. Drag, wheel and arrow keys look around.
 */

import { drawing, makeCanvas } from "../ui/canvas.js";
import { button } from "../ui/controls.js";
import { element } from "../ui/dom.js";
import { loadBitmap } from "./picture_source.js";
import { rayOf } from "./projection.js";
import { amid, angleBetween, anglesAt, anglesOf, directionSaid, filling, outlineIn, positionOf, rayAt, takesRoom, viewTowards, wrapped } from "./strip_geometry.js";
import { centredOn, middle, wheelFactor } from "./viewport.js";

/** @typedef {import("./strip_geometry.js").Extent} Extent */

const HIGHEST_EM = 7;
const STEP_RAD = Math.PI / 36;
const LARGE_STEP_RAD = Math.PI / 6;
const KEY_ZOOM = 1.25;
const FRAME_STEPS = 16;
const SAME_RAD = 0.09; // a pose that was refined is not turned to again

/**
 * @param {HTMLElement} body of the scan's pane
 * @param {import("./controller.js").Controller} controller
 */
export const mountStrip = (body, controller) => {
  const { store, view } = controller;
  const pane = controller.panes.scan;
  const side = controller.sides.scan;
  /** @type {ImageBitmap | null} */
  let picture = null;
  /** @type {string | null} id of its scan */
  let pictured = null;
  /** What the operator aims at; the middle of the pane follows as far as a view reaches. */
  let aim = [0, 0];
  let aiming = false;
  let dragging = false;
  const extent = () => store.scanBeside()?.strip ?? null;
  const photos = () =>
    store.photos()
      .filter(({ station }) => (station ?? "") === store.station()) // outlines are seen from a photograph's own scanner
      .flatMap(({ id, name }) => {
        const outline = store.get(`outline:${id}`);
        return outline ? [{ id, name, ...outline }] : [];
      });

  /**
   * @param {CanvasRenderingContext2D} context
   * @param {number} width
   * @param {number} height
   * @param {(name: string) => string} colour
   * @param {number} em
   */
  const paint = (context, width, height, colour, em) => {
    const strip = extent();
    if (!strip) return;
    const size = [width, height];
    if (picture) {
      context.imageSmoothingQuality = "high";
      context.drawImage(picture, 0, 0, width, height);
    }
    const found = photos().map((photo) => ({ ...photo, ...outlineIn(photo.rays, strip, size) }));
    shade(context, size, found.filter(({ registered }) => registered));
    for (const photo of found) {
      const chosen = photo.id === store.shown();
      trace(context, width, photo.points, chosen ? "#ffd34d" : "#e8ecf2", photo.registered ? [] : [5, 4], chosen ? 2 : 1.25);
    }
    const { lens } = side;
    if (lens && pane.size[0] > 0) trace(context, width, outlineIn(frameRays(lens), strip, size).points, colour("--lr-match-2"), [], 2);
    if (aiming) {
      const [x, y] = positionOf(strip, size, aim);
      for (const [tone, thick] of [["rgba(6, 8, 12, 0.8)", 4], [colour("--lr-match-2"), 1.5]]) {
        Object.assign(context, { strokeStyle: tone, lineWidth: thick });
        context.beginPath();
        context.moveTo(x - 6, y);
        context.lineTo(x + 6, y);
        context.moveTo(x, y - 6);
        context.lineTo(x, y + 6);
        context.stroke();
      }
    }
    /** @type {number[][]} */
    const taken = [];
    const chosenFirst = [...found].sort((a, b) => Number(b.id === store.shown()) - Number(a.id === store.shown()));
    for (const { name, rays } of chosenFirst) label(context, strip, size, name, rays, em, taken);
  };

  /** The border of what the pane shows, as rays. */
  const frameRays = (/** @type {import("./projection.js").ScanView} */ lens) => {
    const [width, height] = pane.size;
    const along = Array.from({ length: FRAME_STEPS }, (_, k) => k / FRAME_STEPS);
    const corners = [
      ...along.map((t) => [t * width, 0]),
      ...along.map((t) => [width, t * height]),
      ...along.map((t) => [(1 - t) * width, height]),
      ...along.map((t) => [0, (1 - t) * height]),
    ];
    return corners.map((xy) => rayOf(lens, pane.pixelAt(xy)));
  };

  const { canvas, draw } = makeCanvas(
    { class: "strip", role: "slider", tabindex: "0", "aria-label": "Overview of the scan: look around", title: "Drag or arrow keys: look around. Wheel, + and -: zoom" },
    paint,
  );
  const go = button({
    label: "Look where the photograph looks", icon: "target", kind: "strip-go", bare: true, title: "Look where the photograph looks (Enter)",
    act: () => lookAtPhoto(),
  });
  const box = element("div", { class: "strip-box", hidden: true }, canvas, go);
  body.before(box);

  const say = () => {
    const angles = aiming ? aim : shownAngles();
    const across = Math.round((angles[0] * 180) / Math.PI);
    canvas.setAttribute("aria-valuemin", "-180");
    canvas.setAttribute("aria-valuemax", "180");
    canvas.setAttribute("aria-valuenow", String(across));
    canvas.setAttribute("aria-valuetext", `looking ${directionSaid(angles)}`);
    const said = photos().map(({ name, rays, registered }) => {
      const towards = amid(rays);
      return `${name}: ${towards ? directionSaid(anglesOf(towards)) : "all around"}${registered ? "" : ", not registered"}`;
    });
    canvas.setAttribute("aria-description", said.length ? `Photographs: ${said.join("; ")}` : "No photograph has a pose yet");
  };

  const shownAngles = () => {
    const { lens } = side;
    return lens && pane.size[0] > 0 ? anglesOf(rayOf(lens, middle(pane.viewport, pane.size))) : aim;
  };

  /** Turn the pane to a direction; the picks and what is being drawn are directions, and stay. @param {readonly number[]} angles */
  const lookAt = (angles) => {
    const { scan } = side;
    const strip = extent();
    if (!scan || !strip || !side.lens || pane.size[0] === 0) return;
    aim = [wrapped(angles[0]), Math.min(strip.high, Math.max(strip.low, angles[1]))];
    const ray = rayAt(aim[0], aim[1]);
    const index = viewTowards(scan.views, ray, side.index, dragging);
    if (index !== side.index) view.set({ scan: { view: index } });
    const uv = side.toPixel(ray);
    if (uv && pane.extent) pane.place(filling(centredOn(uv, pane.viewport.zoom, pane.size), pane.size, pane.extent), "strip");
    aiming = true; // now: another view moves the pane, too
    changed();
  };

  /** @returns {number[] | null} where the shown photograph looks, as far as that is known */
  const ofShown = () => {
    const outline = store.get(`outline:${store.shown()}`);
    return outline ? amid(outline.rays) : null;
  };

  const lookAtPhoto = () => {
    const ray = ofShown();
    if (ray) lookAt(anglesOf(ray));
  };

  /** @param {MouseEvent} event */
  const lookAtPointer = (event) => {
    const strip = extent();
    const bounds = canvas.getBoundingClientRect();
    if (strip) lookAt(anglesAt(strip, [bounds.width, bounds.height], [event.clientX - bounds.left, event.clientY - bounds.top]));
  };
  canvas.addEventListener("pointerdown", (event) => {
    if (event.button !== 0 || !extent()) return;
    canvas.setPointerCapture(event.pointerId);
    dragging = true;
    lookAtPointer(event);
  });
  const rest = () => {
    if (!dragging) return;
    dragging = false;
    if (aiming) lookAt(aim); // in the view whose middle is nearest
  };
  canvas.addEventListener("pointermove", (event) => dragging && lookAtPointer(event));
  for (const name of ["pointerup", "pointercancel", "lostpointercapture"]) canvas.addEventListener(name, rest);

  /** @param {number} factor */
  const zoomBy = (factor) => {
    const angles = aiming ? aim : shownAngles();
    pane.zoomTo(pane.viewport.zoom * factor, "strip");
    lookAt(angles);
  };
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoomBy(wheelFactor(event));
  }, { passive: false });

  /** @type {Partial<Record<string, readonly [number, number]>>} */
  const STEPS = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
  canvas.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const step = STEPS[event.key];
    if (step) {
      const from = aiming ? aim : shownAngles();
      const by = event.shiftKey ? LARGE_STEP_RAD : STEP_RAD;
      lookAt([from[0] + step[0] * by, from[1] + step[1] * by]);
    } else if (event.key === "+" || event.key === "=") zoomBy(KEY_ZOOM);
    else if (event.key === "-") zoomBy(1 / KEY_ZOOM);
    else if (event.key === "Home") lookAt([0, 0]);
    else if (event.key === "Enter") lookAtPhoto();
    else return;
    event.preventDefault();
    event.stopPropagation();
  });

  const changed = () => {
    go.hidden = !ofShown();
    say();
    draw();
  };
  pane.onMove((_, by) => {
    if (by !== "strip") aiming = false;
    changed();
  });

  /** @param {string | null} id */
  const load = async (id) => {
    if (id === pictured) return;
    pictured = id;
    picture = null;
    if (id === null) return;
    try {
      const bitmap = await loadBitmap(`picture/strip?rev=${encodeURIComponent(id)}`);
      if (id === pictured) picture = bitmap;
    } catch {
      if (id === pictured) pictured = null; // the outlines are shown without it; the next slice loads it again
    }
    draw();
  };

  const show = () => {
    const strip = extent();
    box.hidden = !strip;
    if (strip) {
      const share = (strip.high - strip.low) / (2 * Math.PI);
      box.style.setProperty("--lr-strip", `min(${(100 * share).toFixed(3)}cqw, ${HIGHEST_EM}rem)`);
    }
    load(strip ? store.scanBeside()?.id ?? null : null);
    changed();
  };

  /** Where the pose of each photograph looked last; undefined: not known since the page has opened. */
  /** @type {Map<string, number[] | null>} */
  const towards = new Map();
  /** @type {string | null} */
  let shown = null;
  const follow = () => {
    const known = store.photos();
    for (const { id } of known) {
      const outline = store.get(`outline:${id}`);
      const now = outline ? amid(outline.rays) : null;
      const before = towards.get(id);
      towards.set(id, now);
      const moved = before !== undefined && now && (!before || angleBetween(before, now) > SAME_RAD);
      if (moved && outline?.registered && id === store.shown() && controller.picking.idle) lookAt(anglesOf(now));
    }
    // Another photograph that is chosen turns the pane, too, but not the first one of a page that opens.
    const id = store.shown();
    if (id !== shown && shown !== null && controller.picking.idle && store.get(`outline:${id}`)?.registered) lookAtPhoto();
    shown = id;
  };
  store.watch(["scan", "beside"], () => {
    towards.clear();
    show();
    follow();
  });
  store.watch(["photos", "shown", "outline:*"], () => {
    follow();
    changed();
  });
  view.on((_, names) => names.has("scan") && changed());
  show();
};

/**
 * Trace an outline three times, so that what leaves the strip on one side enters it on the other.
 * @param {CanvasRenderingContext2D | OffscreenCanvasRenderingContext2D} context
 * @param {number} width
 * @param {number[][]} points
 */
const path = (context, width, points) => {
  context.beginPath();
  for (const turn of [-width, 0, width]) {
    points.forEach(([x, y], k) => (k ? context.lineTo(x + turn, y) : context.moveTo(x + turn, y)));
    if (points.length) context.closePath();
  }
};

/**
 * @param {CanvasRenderingContext2D} context
 * @param {number} width
 * @param {number[][]} points
 * @param {string} colour
 * @param {number[]} dash
 * @param {number} thick
 */
const trace = (context, width, points, colour, dash, thick) => {
  path(context, width, points);
  context.setLineDash([]);
  Object.assign(context, { strokeStyle: "rgba(6, 8, 12, 0.75)", lineWidth: thick + 2 });
  context.stroke();
  context.setLineDash(dash);
  Object.assign(context, { strokeStyle: colour, lineWidth: thick });
  context.stroke();
  context.setLineDash([]);
};

/**
 * Shade what none of the photographs covers.
 * @param {CanvasRenderingContext2D} context
 * @param {readonly number[]} size
 * @param {{rays: number[][], points: number[][]}[]} covering
 */
const shade = (context, [width, height], covering) => {
  if (covering.length === 0 || covering.some(({ rays }) => rays.length === 0)) return; // none yet, or one that looks all around
  const ratio = window.devicePixelRatio || 1;
  const veil = new OffscreenCanvas(Math.max(1, Math.round(width * ratio)), Math.max(1, Math.round(height * ratio)));
  const over = drawing(veil.getContext("2d"));
  over.scale(veil.width / width, veil.height / height);
  over.fillStyle = "rgba(8, 10, 13, 0.55)";
  over.fillRect(0, 0, width, height);
  over.globalCompositeOperation = "destination-out";
  over.fillStyle = "#000";
  for (const { points } of covering) {
    path(over, width, points);
    over.fill();
  }
  context.drawImage(veil, 0, 0, width, height);
};

/**
 * Write a name where there is room.
 * @param {number[][]} taken left, top, right, bottom of the names that are written
 * @param {CanvasRenderingContext2D} context
 * @param {Extent} strip
 * @param {readonly number[]} size
 * @param {string} name
 * @param {number[][]} rays
 * @param {number} em
 */
const label = (context, strip, size, name, rays, em, taken) => {
  const towards = amid(rays);
  if (!towards) return;
  const [x, y] = positionOf(strip, size, anglesOf(towards));
  const text = name.length > 18 ? `${name.slice(0, 16)}…` : name;
  const half = context.measureText(text).width / 2 + 3;
  const inside = Math.min(size[0] - half, Math.max(half, x));
  const line = Math.min(size[1] - 0.8 * em, Math.max(0.8 * em, y));
  if (!takesRoom(taken, [inside - half, line - 0.7 * em, inside + half, line + 0.7 * em])) return;
  Object.assign(context, { textAlign: "center", textBaseline: "middle", fillStyle: "rgba(9, 11, 14, 0.8)" });
  context.fillRect(inside - half, line - 0.7 * em, 2 * half, 1.4 * em);
  context.fillStyle = "#e8ecf2";
  context.fillText(text, inside, line);
};
