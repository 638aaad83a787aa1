/** A rough pose given by hand: the 3-D view as the camera, or a camera that is moved and turned step by step. */

import { requestForPhoto } from "../../net/requests.js";
import { store } from "../../net/store.js";
import { jobOn } from "../../state/pipeline.js";
import { view } from "../../state/view.js";
import { button, fill } from "../../ui/controls.js";
import { element } from "../../ui/dom.js";

/** @type {Record<string, [number, number]>} m, deg */
const STEPS = { fine: [0.01, 0.2], medium: [0.05, 1], coarse: [0.25, 5] };
/** @type {[string, string][]} */
const STEP_LABELS = [["fine", "1 cm, 0.2°"], ["medium", "5 cm, 1°"], ["coarse", "25 cm, 5°"]];
/**
 * Each with its sign, and how many steps it moves (right, down, forward) and turns (up, right, clockwise).
 * @type {[string, string, number[], number[]][]}
 */
const MOVES = [
  ["Move left", "←", [-1, 0, 0], [0, 0, 0]],
  ["Move right", "→", [1, 0, 0], [0, 0, 0]],
  ["Move up", "↑", [0, -1, 0], [0, 0, 0]],
  ["Move down", "↓", [0, 1, 0], [0, 0, 0]],
  ["Move forward", "+", [0, 0, 1], [0, 0, 0]],
  ["Move back", "−", [0, 0, -1], [0, 0, 0]],
];
/** @type {[string, string, number[], number[]][]} */
const TURNS = [
  ["Turn left", "←", [0, 0, 0], [0, -1, 0]],
  ["Turn right", "→", [0, 0, 0], [0, 1, 0]],
  ["Turn up", "↑", [0, 0, 0], [1, 0, 0]],
  ["Turn down", "↓", [0, 0, 0], [-1, 0, 0]],
  ["Tilt left", "↺", [0, 0, 0], [0, 0, -1]],
  ["Tilt right", "↻", [0, 0, 0], [0, 0, 1]],
];
/** @type {Record<string, number>} */
const KEYS = { ArrowLeft: 0, ArrowRight: 1, ArrowUp: 2, ArrowDown: 3, PageUp: 4, PageDown: 5 };

/** @returns {string} why nothing can be registered from a rough pose now; empty if it can */
const missing = () => {
  if (!store.get("scan")) return "Open a scan first";
  if (!store.photo()?.camera) return "Needs a photograph with a known focal length";
  return jobOn(store.get("job"), store.shown()) ? "A job is running" : "";
};

/**
 * Show the camera at a pose, as the workbench answers, with what it would see of the scan over the photograph.
 * @param {Omit<import("../../net/requests.js").Commands["place_camera"], "photo">} how
 */
const place = async (how) => {
  const reply = await requestForPhoto("place_camera", how);
  if (!reply) return false;
  const { camera_from_scanner: pose } = reply;
  const photo = store.shown();
  view.set({ placement: pose && photo ? { photo, pose } : null });
  return true;
};

const endPlacing = () => {
  if (view.get().placement) place({});
};

/**
 * The controls of the rough pose, for the sheet of the 3-D view's settings.
 * @param {HTMLElement} sheet closed once it has begun
 * @returns {HTMLElement}
 */
export const roughPose = (sheet) => {
  const refine = button({
    label: "Refine from here",
    kind: "primary",
    act: async () => {
      if (await requestForPhoto("refine")) sheet.hidePopover();
    },
  });
  const byHand = button({
    label: "Place by hand",
    act: async () => {
      const start = store.stageOf() ? "pose" : "scanner";
      if (await place({ start })) sheet.hidePopover();
    },
  });
  const show = () => {
    const why = missing();
    for (const control of [refine, byHand]) {
      control.disabled = Boolean(why) || store.readOnly;
      control.title = why;
    }
  };
  store.watch(["scan", "photos", "shown", "job", "people"], show);
  show();
  return element(
    "section",
    { class: "rough-pose", "aria-label": "Rough pose" },
    element("h3", {}, "Rough pose"),
    element(
      "p",
      {},
      "Move the 3-D view to about where the camera stood, until it looks like the photograph. The registration then " +
        "starts from this view, with the photograph's own camera. Or place the camera by hand, and see over the " +
        "photograph what it would see.",
    ),
    element("div", { class: "row" }, refine, byHand),
  );
};

/** @returns {HTMLElement} the controls of a camera that is being placed, over the 3-D view */
export const placingBar = () => {
  const step = element("select", { class: "select small", "aria-label": "Step" });
  fill(step, STEP_LABELS, "medium");
  /** @param {[string, string, number[], number[]]} move */
  const nudge = ([, , shift, turn]) => {
    const { placement } = view.get();
    if (!placement) return;
    const [length, angle] = STEPS[step.value];
    place({ camera_from_scanner: placement.pose, shift_m: shift.map((n) => n * length), turn_deg: turn.map((n) => n * angle) });
  };
  /** @param {string} label @param {typeof MOVES} moves */
  const pad = (label, moves) =>
    element(
      "div",
      { class: "placing-pad", role: "group", "aria-label": label },
      element("span", { class: "dim" }, label),
      ...moves.map((move) => button({ label: move[0], text: move[1], title: move[0], kind: "small", act: () => nudge(move) })),
    );
  const refine = button({
    label: "Refine from this pose",
    text: "Refine",
    kind: "primary small",
    title: "Register automatically, starting from this pose",
    act: async () => {
      const { placement } = view.get();
      if (placement && await requestForPhoto("refine", { camera_from_scanner: placement.pose })) endPlacing();
    },
  });
  /** @param {"scanner" | "view"} start @param {string} label @param {string} title */
  const from = (start, label, title) => button({ label, kind: "small", title, act: () => place({ start }) });
  const [fromView, fromScanner] = [
    from("view", "From this view", "Put the camera where the 3-D view looks from"),
    from("scanner", "From the scanner", "Put the camera at the scanner"),
  ];
  const bar = element(
    "section",
    { class: "placing", "aria-label": "Place the camera", tabIndex: -1, hidden: true },
    element(
      "div",
      { class: "row" },
      element("span", { class: "placing-title" }, "Place the camera"),
      fromView,
      fromScanner,
    ),
    element("div", { class: "row" }, pad("Move", MOVES), pad("Turn", TURNS)),
    element("div", { class: "row" }, step, element("span", { class: "placing-title" }), refine, button({ label: "Stop placing", text: "Cancel", kind: "small", act: endPlacing })),
  );
  bar.title = "Arrow keys move the camera, Page Up and Page Down forward and back; with Shift the arrows turn it";
  bar.addEventListener("keydown", (event) => {
    if (event.target === step || event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key === "Escape") endPlacing();
    const at = KEYS[event.key];
    if (at !== undefined) nudge(event.shiftKey && at < 4 ? TURNS[at] : MOVES[at]);
    if (at === undefined && event.key !== "Escape") return;
    event.preventDefault();
    event.stopPropagation();
  });
  const show = () => {
    const { placement } = view.get();
    const opens = bar.hidden && placement !== null;
    bar.hidden = placement === null;
    const why = missing();
    refine.disabled = Boolean(why);
    if (opens) bar.focus({ preventScroll: true });
  };
  view.on((_, changed) => changed.has("placement") && show());
  store.watch(["scan", "photos", "shown", "job"], () => {
    const { placement } = view.get();
    if (placement && placement.photo !== store.shown()) {
      view.set({ placement: null });
      requestForPhoto("place_camera", {}); // its handle is in the 3-D view
    }
    show();
  });
  store.onEvent("placement", ({ photo, camera_from_scanner: pose }) => {
    const { placement } = view.get();
    if (placement && photo === placement.photo) view.set({ placement: { photo, pose } });
  });
  return bar;
};
