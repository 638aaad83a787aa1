/** The two image panes: scan and photograph side by side, with the matches drawn in them. */

import { followSimplex } from "../state/simplex_run.js";
import { throttled } from "../ui/throttle.js";
import { Colleagues } from "./colleagues.js";
import { mountSwipe } from "./compare.js";
import { Controller } from "./controller.js";
import { mountPhotoHead, mountScanHead } from "./heads.js";
import { listenToKeys } from "./keyboard.js";
import { linkPanes } from "./linked_views.js";
import { mountModelMeasuring } from "./model_measuring.js";
import { mountPane } from "./pane_setup.js";
import { readoutOf } from "./readout.js";
import { listenToReveals } from "./reveal.js";
import { SimplexPreview } from "./simplex_preview.js";
import { mountStrip } from "./strip.js";
import { Tools } from "./tools.js";
import { keepUnfinished } from "./unfinished.js";

/** @typedef {import("../state/view.js").ViewState} ViewState */

/** @type {("scan" | "photo")[]} */
const SIDES = ["scan", "photo"];
/** @type {(keyof ViewState)[]} what the layers show, besides the slices */
const LIVE = ["hovered", "selected", "end", "loupe", "snap", "marks", "measurement", "placement", "smoothed", "smooth_edges"];
/** @type {(keyof ViewState)[]} */
const MATCHES = ["corners", "marks", "placement", "step"];
const PICTURE_INTERVAL_MS = 180;

/**
 * Mount the two image panes.
 * @param {{scanHead: HTMLElement, scanBody: HTMLElement, photoHead: HTMLElement, photoBody: HTMLElement,
 *          model?: ReturnType<typeof import("../panels/model/model_pane.js").mountModelPane>,
 *          store: import("../net/store.js").Store, view: typeof import("../state/view.js").view, ask: typeof import("../net/connection.js").ask}} page
 */
export const mountPanes = ({ scanHead, scanBody, photoHead, photoBody, model, store, view, ask }) => {
  const controller = new Controller({ store, view, ask });
  const tools = new Tools(controller);
  const space = { held: false, used: false };
  followSimplex(store);
  const preview = new SimplexPreview((began) => {
    controller.panes.photo?.invalidate("live");
    if (began) controller.panes.photo?.invalidate("matches");
  });
  const shared = { controller, tools, preview, space, readout: readoutOf(controller) };
  const bodies = { scan: scanBody, photo: photoBody };
  const built = Object.fromEntries(SIDES.map((side) => [side, mountPane(bodies[side], side, shared)]));
  /** @param {HTMLElement} head */
  const controlsOf = (head) => /** @type {HTMLElement | null} */ (head.querySelector(".pane-controls")) ?? head;
  mountScanHead(controlsOf(scanHead), controller);
  mountPhotoHead(controlsOf(photoHead), controller);
  mountSwipe(controller);
  linkPanes(controller);
  controller.colleagues = new Colleagues(controller, tools);
  controller.colleagues.watchPanes();
  listenToKeys(controller, tools, space);
  listenToReveals(controller);
  mountStrip(scanBody, controller);
  if (model) mountModelMeasuring(model, controller);

  keepUnfinished(controller.picking, store);

  const showNotes = () => SIDES.forEach((side) => built[side].notes.show());
  controller.onPickingChanged = showNotes;

  const loadPictures = () => {
    for (const side of SIDES) {
      if (side === "scan" && view.get().stretching) continue; // it follows when the slider is released
      const { address, subject, extent, stretch } = controller.sides[side];
      built[side].slots.picture.show(address, { subject, size: extent, stretch });
    }
    built.photo.slots.compare?.show(controller.sides.photo.overlayAddress);
  };
  /** While a key moves a slider, a few pictures a second are enough. */
  const loadPicturesSoon = throttled(loadPictures, PICTURE_INTERVAL_MS);

  /** @type {Partial<Record<"scan" | "photo", string | null>>} */
  const shownIds = {};
  const showSlices = () => {
    const before = { ...shownIds };
    for (const side of SIDES) {
      const { id, extent } = controller.sides[side];
      if (id !== shownIds[side]) {
        controller.cursor = null;
        tools.abandon();
      }
      controller.panes[side].setExtent(extent);
      shownIds[side] = id;
    }
    /** @param {"scan" | "photo"} side */
    const replaced = (side) => Boolean(before[side]) && before[side] !== shownIds[side];
    if (replaced("photo")) view.set({ selected: new Set(), end: null, hovered: null }); // others have matches of the same ids
    if (replaced("scan") || before.photo !== shownIds.photo) controller.turnTo(replaced("scan"));
    loadPictures();
    controller.changed();
    controller.hint();
    showNotes();
  };
  store.watch(["scan", "beside", "photos", "shown", "poses:*"], showSlices);
  store.watch(["picks:*", "judged:*", "corners:*", "ties:*", "measurements", "measured", "smoothing"], () => {
    controller.forgetArrived();
    controller.changed();
  });

  /** @param {ViewState} state */
  const applyFilters = (state) => {
    for (const side of SIDES) {
      bodies[side].style.setProperty("--lr-brightness", String(state[side].brightness));
      bodies[side].style.setProperty("--lr-contrast", String(state[side].contrast));
      // a filter without effect would still be computed for every frame
      bodies[side].classList.toggle("lit", state[side].brightness !== 1 || state[side].contrast !== 1);
    }
  };
  let shownView = controller.sides.scan.index;
  view.on((state, changed) => {
    if (changed.has("scan") || changed.has("photo")) applyFilters(state);
    if (changed.has("scan") || changed.has("stretching")) {
      if (controller.sides.scan.index !== shownView) {
        controller.picking.turned("scan", (ray) => controller.sides.scan.toPixel(ray));
        showSlices();
      } else if (state.stretching) built.scan.slots.picture.preview(controller.sides.scan.stretch);
      else loadPicturesSoon();
      shownView = controller.sides.scan.index;
    }
    if (changed.has("photo") || changed.has("placement")) {
      loadPicturesSoon();
      controller.panes.photo.invalidate("compare");
    }
    if (changed.has("tool")) {
      if (controller.picking.drawing) controller.picking.abandon();
      controller.handle("nothing");
    }
    if (changed.has("selected")) controller.hint();
    if (LIVE.some((name) => changed.has(name))) controller.redraw("live");
    if (MATCHES.some((name) => changed.has(name))) controller.redraw("matches");
  });
  applyFilters(view.get());
  showSlices();
};
