/** A run: what it has seen so far all around, how far it is, and its controls. Dragging over the picture sets the plan. */

import { request } from "../../net/requests.js";
import { store } from "../../net/store.js";
import { acquisitionNow, changePlan, isActive, onPlan, othersDrive, overviewPlan, planNow } from "../../state/acquisition.js";
import { button } from "../../ui/controls.js";
import { element, setChildren, setText } from "../../ui/dom.js";
import { isNumber } from "../../ui/numbers.js";

/** @typedef {import("../../protocol.d.ts").AcquiredRun} Run */

const [WIDTH, HEIGHT] = [720, 360];
const MIN_DRAG_PX = 6;

/** @param {number} degrees */
const wrapped = (degrees) => ((((degrees + 180) % 360) + 360) % 360) - 180;

/**
 * How the unit stands in its picture, which is level.
 * @returns {{way: 1 | -1, yaw: number}} -1 for a unit that hangs: its left is on the right; and the longitude of pan 0, degrees
 */
const stance = () => {
  const base = planNow()?.mount?.base;
  const [roll, pitch, yaw] = base === "hanging" ? [180, 0, 0] : Array.isArray(base) ? base : [0, 0, 0];
  const up = Math.cos((roll * Math.PI) / 180) * Math.cos((pitch * Math.PI) / 180);
  return { way: up < 0 ? -1 : 1, yaw: wrapped(yaw) };
};

/**
 * @param {number} x
 * @param {number} y
 * @returns {[number, number]} pan and tilt, degrees, of a place in the picture: the unit's left is positive
 */
const anglesAt = (x, y) => {
  const { way, yaw } = stance();
  const pan = way * (180 - (x / WIDTH) * 360 - yaw);
  return [yaw ? wrapped(pan) : pan, way * (90 - (y / HEIGHT) * 180)];
};
/** @param {number} pan @param {number} tilt */
const placeOf = (pan, tilt) => {
  const { way, yaw } = stance();
  return [((180 - yaw - way * pan) / 360) * WIDTH, ((90 - way * tilt) / 180) * HEIGHT];
};

/** @param {number} seconds */
const leftText = (seconds) =>
  seconds < 1 ? "" : seconds < 90 ? `${seconds} s left` : `${Math.round(seconds / 60)} min left`;

/** @param {import("../../state/acquisition.js").Entered | undefined} axis @returns {number[] | null} from, to and step; null unless all are entered */
const axisOf = (axis) => {
  const numbers = Array.isArray(axis) ? axis.filter(isNumber) : [];
  return numbers.length === 3 && axis?.length === 3 ? numbers : null;
};

/** Halt the unit and switch the laser off, without a question. */
export const stopAcquisition = () => request("acquire_stop");

/** @returns {HTMLElement} the panel */
export const mountRun = () => {
  const picture = element("img", { class: "run-picture", alt: "", draggable: false, hidden: true });
  const range = element("div", { class: "run-range", hidden: true });
  const overview = element(
    "div",
    { class: "run-overview", title: "Drag to choose what is scanned" },
    picture,
    range,
  );
  const bar = element("progress", { max: 1, value: 0, "aria-label": "Progress of the run" });
  const counted = element("span", { class: "figures" });
  const said = element("p", { class: "acquire-said", role: "status" });
  const start = button({ label: "Start", icon: "play", kind: "primary small", act: () => begin(null) });
  const goOn = button({ label: "Go on with the run", text: "Go on", icon: "play", kind: "small", act: () => begin(acquisitionNow().run) });
  const look = button({
    label: "Quick overview",
    text: "Overview",
    kind: "small",
    title: "A coarse sweep, over whose picture you drag what is to be scanned",
    act: () => {
      const plan = overviewPlan();
      if (plan) request("acquire_start", { plan });
    },
  });
  const pause = button({ label: "Pause", icon: "pause", kind: "small", act: () => request("acquire_pause") });
  const resume = button({ label: "Resume", icon: "play", kind: "primary small", act: () => request("acquire_resume") });
  const stop = button({
    label: "Stop the unit and switch the laser off",
    text: "Stop  F8",
    icon: "stop",
    kind: "small stop-button",
    title: "F8, anywhere on the page. It is no safety device: a hardware stop must be within reach.",
    act: stopAcquisition,
  });
  const open = button({ label: "Open as the scan", kind: "primary small", act: () => request("acquire_open") });
  const runs = element("ul", { class: "run-list", "aria-label": "Runs of this project" });
  const part = element(
    "section",
    { class: "dock-part acquire-run", "aria-label": "Run" },
    element(
      "div",
      { class: "part-head" },
      element("h2", {}, "Run"),
      element("div", { class: "end edits" }, look, start, goOn, pause, resume, stop, open),
    ),
    element(
      "div",
      { class: "part-body run-body" },
      overview,
      element("div", { class: "run-line" }, bar, counted),
      said,
      runs,
    ),
  );

  /** @param {string | null} run */
  const begin = (run) => request("acquire_start", run ? { resume: run } : { plan: planNow() });

  /** Show the range of the plan over the picture. */
  const showRange = () => {
    const { pan_deg, tilt_deg, mode } = planNow() ?? {};
    const [pan, tilt] = [axisOf(pan_deg), axisOf(tilt_deg)];
    range.hidden = !pan || !tilt;
    if (!pan || !tilt) return;
    const [left, right] = [Math.max(pan[0], pan[1]), Math.min(pan[0], pan[1])];
    // The line of a sweep covers all elevations.
    const [top, bottom] = mode === "sweep" ? [90, -90] : [Math.max(tilt[0], tilt[1]) + 1, Math.min(tilt[0], tilt[1]) - 1];
    const ends = [placeOf(Math.min(left, 180), top), placeOf(Math.max(right, -180), bottom)];
    const [[x0, y0], [x1, y1]] = stance().way > 0 ? ends : ends.reverse();
    const style = { left: x0 / WIDTH, top: y0 / HEIGHT, width: (x1 - x0) / WIDTH, height: (y1 - y0) / HEIGHT };
    for (const [name, share] of Object.entries(style)) range.style.setProperty(name, `${100 * share}%`);
  };

  /** @type {{x: number, y: number, place: [number, number]} | null} where dragging began */
  let from = null;
  /** @returns {[number, number]} */
  const place = (/** @type {MouseEvent} */ event) => {
    const box = overview.getBoundingClientRect();
    const share = (/** @type {number} */ value, /** @type {number} */ low, /** @type {number} */ size) => Math.min(1, Math.max(0, (value - low) / size));
    return [share(event.clientX, box.left, box.width) * WIDTH, share(event.clientY, box.top, box.height) * HEIGHT];
  };
  overview.addEventListener("pointerdown", (event) => {
    if (event.button !== 0 || isActive() || store.readOnly || !planNow()) return;
    from = { x: event.clientX, y: event.clientY, place: place(event) };
    overview.setPointerCapture(event.pointerId);
  });
  overview.addEventListener("pointermove", (event) => {
    const plan = planNow();
    if (!from || !plan || Math.hypot(event.clientX - from.x, event.clientY - from.y) < MIN_DRAG_PX) return;
    const [a, b] = [anglesAt(...from.place), anglesAt(...place(event))];
    const low = acquisitionNow().devices?.lowest_deg ?? [-168, -46];
    const high = acquisitionNow().devices?.highest_deg ?? [168, 30];
    const within = (/** @type {number} */ value, /** @type {number} */ k) => Math.round(10 * Math.min(high[k], Math.max(low[k], value))) / 10;
    const axis = (/** @type {number} */ k, /** @type {number | null | undefined} */ step) => {
      const [first, last] = [within(Math.min(a[k], b[k]), k), within(Math.max(a[k], b[k]), k)];
      return [first, last, Math.abs(step || 1)];
    };
    const pan_deg = axis(0, plan.pan_deg?.[2]);
    // A line scanner that stands upright covers all elevations: only the pan is dragged for a sweep at one tilt.
    const sweep = plan.mode === "sweep" && plan.tilt_deg?.[0] === plan.tilt_deg?.[1];
    changePlan(sweep ? { pan_deg } : { pan_deg, tilt_deg: axis(1, plan.tilt_deg?.[2]) });
  });
  for (const end of ["pointerup", "pointercancel"]) overview.addEventListener(end, () => {
    from = null;
  });

  let listed = "";
  /** @param {Run[]} list @param {boolean} active @param {boolean} ready */
  const showRuns = (list, active, ready) => {
    runs.hidden = active || !list.length;
    const text = JSON.stringify([list, ready, store.readOnly]);
    if (text === listed) return;
    listed = text;
    setChildren(runs, ...list.map((run) => {
      /** @param {string} label @param {string} verb @param {() => void} act @param {string} title @param {boolean} [disabled] */
      const small = (label, verb, act, title, disabled = false) =>
        button({ label: `${label} ${run.name}`, text: verb, kind: "small", title, act, disabled: disabled || store.readOnly });
      const photos = run.photos === 1 ? "1 photograph" : `${run.photos} photographs`;
      return element(
        "li",
        {},
        element("span", { class: "run-name" }, run.name),
        element("span", { class: "dim figures" }, `${run.done} of ${run.total}`),
        run.complete
          ? small("Open", "Open", () => request("acquire_open", { run: run.name }), "Open its panorama as the scan")
          : small("Go on with", "Go on", () => begin(run.name), ready ? "Measure what is missing" : "Connect the devices first", !ready),
        run.photos > 0 &&
          small("Add photographs of", photos, () => request("acquire_photos", { run: run.name }), "Add them to the project"),
      );
    }));
  };

  /** @type {string | null} */
  let shown = null;
  const showPicture = (/** @type {string | null} */ rev) => {
    if (rev === shown) return;
    shown = rev;
    picture.hidden = !rev;
    if (rev) picture.src = `picture/acquisition?rev=${rev}`;
  };

  const show = () => {
    const state = acquisitionNow();
    const active = isActive();
    const theirs = othersDrive();
    const unfinished = state.state === "ready" && Boolean(state.run) && !state.complete;
    start.hidden = active;
    look.hidden = active || !overviewPlan();
    look.disabled = state.state !== "ready" || theirs;
    start.disabled = state.state !== "ready" || theirs;
    goOn.hidden = !unfinished;
    goOn.disabled = theirs;
    pause.hidden = state.state !== "running";
    resume.hidden = !["paused", "fault"].includes(state.state);
    pause.disabled = resume.disabled = theirs;
    stop.hidden = !state.devices;
    open.hidden = !state.complete || active;
    bar.value = state.total ? state.done / state.total : 0;
    setText(counted, state.total ? [`${state.done} of ${state.total}`, leftText(active ? state.seconds_left : 0)].filter(Boolean).join(", ") : "");
    setText(said, active || state.run || state.said ? state.said : "Connect the devices, choose what is scanned, and start.");
    said.classList.toggle("bad", state.state === "fault");
    overview.classList.toggle("idle", !active && !store.readOnly);
    showRuns(state.runs, active, state.state === "ready" && !theirs);
    showPicture(state.picture);
    showRange();
  };
  store.watch(["acquisition", "people"], show);
  onPlan(show);
  show();
  return part;
};
