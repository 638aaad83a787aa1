/** Puts one pane together: layers, loupe, notes, tools, and the pointers on it. */

import { listenToPointers } from "./pointer.js";
import { LiveLayer } from "./live_layer.js";
import { Loupe } from "./loupe.js";
import { Notes } from "./notes.js";
import { Painting } from "./painting.js";
import { Pane } from "./pane.js";
import { Slot } from "./picture_layer.js";
import { mountToolbox } from "./toolbar.js";

const LABELS = { scan: "Scan: draw and move matches", photo: "Photograph: draw and move matches" };
const BY_KEYS =
  "Arrow keys move the crosshair and Enter sets an end there. " +
  "Tab walks through the matches, arrow keys move the selected end; Escape and then Tab leaves.";

const introduce = (body, side) => {
  body.tabIndex = 0;
  body.setAttribute("role", "application");
  body.setAttribute("aria-label", LABELS[side]);
  body.setAttribute("aria-description", BY_KEYS);
};

/** @returns {number} where the swipe stands in the loupe, which shows another part at another zoom */
const swipeInLoupe = (pane, swipe_x, viewport) => ((swipe_x - pane.viewport.x) / pane.viewport.zoom) * viewport.zoom + viewport.x;

/**
 * @param {HTMLElement} body
 * @param {"scan" | "photo"} side
 * @param {{desk: any, strokes: any, running: any, readout: any, space: any}} shared
 * @returns {{pane: Pane, slots: {picture: Slot, compare: Slot | null}, notes: Notes}}
 */
export const onePane = (body, side, { desk, strokes, running, readout, space }) => {
  introduce(body, side);
  const changed = () => {
    notes.show();
    pane.invalidate("picture", "compare", "live");
  };
  const slots = { picture: new Slot(changed), compare: side === "photo" ? new Slot(changed) : null };
  const painting = new Painting({ desk, side, slots, strokes, running });
  const swipe_x = () => desk.view.get().photo.swipe * pane.size[0];
  const pane = new Pane(body, side, {
    picture: (context) => painting.picture(context, pane.viewport, pane.size),
    compare: (context) => painting.compare(context, pane.viewport, pane.size, swipe_x()),
    matches: (context) => painting.matches(context, pane.viewport, pane.size),
    live: (context) => layer.paint(context),
  });
  desk.panes[side] = pane;
  const loupe = new Loupe(
    pane,
    (context, viewport, size) => {
      painting.picture(context, viewport, size);
      painting.compare(context, viewport, size, swipeInLoupe(pane, swipe_x(), viewport));
    },
    (context, viewport, size) => {
      painting.matches(context, viewport, size);
      painting.live(context, viewport, size, 0, false);
    },
  );
  const layer = new LiveLayer({ desk, pane, painting, strokes, loupe });
  const notes = new Notes(desk, pane, slots);
  mountToolbox(desk, pane);
  listenToPointers(pane, strokes, space);
  strokes.onPointer((at, uv) => at === pane && readout(pane, uv));
  pane.onMove(() => strokes.pictureMoved(pane));
  return { pane, slots, notes };
};
