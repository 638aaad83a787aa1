/** Assembly of one pane: layers, loupe, texts, tools and pointer events. */

import { LiveLayer } from "./live_layer.js";
import { Loupe } from "./loupe.js";
import { mountMeasureBar } from "./measure_bar.js";
import { Notes } from "./notes.js";
import { Painting } from "./painting.js";
import { Pane } from "./pane.js";
import { Slot } from "./picture_layer.js";
import { listenToPointers } from "./pointer.js";
import { mountToolbar } from "./toolbar.js";

/**
 * @typedef {import("./viewport.js").Viewport} Viewport
 * @typedef {import("./picking.js").Side} Side
 */

const LABELS = { scan: "Scan: draw and move matches", photo: "Photograph: draw and move matches" };
const KEYS_HINT =
  "Arrow keys move the crosshair, Enter sets an end there. " +
  "Tab steps through the matches, arrow keys move the selected end; press Escape, then Tab to leave the pane.";

/** @param {HTMLElement} body @param {Side} side */
const describe = (body, side) => {
  body.tabIndex = 0;
  body.setAttribute("role", "application");
  body.setAttribute("aria-label", LABELS[side]);
  body.setAttribute("aria-description", KEYS_HINT);
};

/**
 * @param {Pane} pane
 * @param {number} swipe_x
 * @param {Viewport} viewport
 * @returns {number} position of the swipe in the loupe, which shows another part at another zoom
 */
const swipeInLoupe = (pane, swipe_x, viewport) => ((swipe_x - pane.viewport.x) / pane.viewport.zoom) * viewport.zoom + viewport.x;

/**
 * @param {HTMLElement} body
 * @param {"scan" | "photo"} side
 * @param {{controller: import("./controller.js").Controller, tools: import("./tools.js").Tools,
 *   preview: import("./simplex_preview.js").SimplexPreview, readout: ReturnType<typeof import("./readout.js").readoutOf>,
 *   space: {held: boolean, used: boolean}}} shared
 * @returns {{pane: Pane, slots: {picture: Slot, compare: Slot | null}, notes: Notes}}
 */
export const mountPane = (body, side, { controller, tools, preview, readout, space }) => {
  describe(body, side);
  const first = body.querySelector(".first-picture");
  const changed = () => {
    if (!slots.picture.picture && !slots.picture.loading) first?.remove();
    notes.show();
    pane.invalidate("picture", "compare", "live");
  };
  const slots = { picture: new Slot(changed), compare: side === "photo" ? new Slot(changed) : null };
  const painting = new Painting({ controller, side, slots, tools, preview });
  const swipe_x = () => controller.view.get().photo.swipe * pane.size[0];
  /** @type {Pane} */
  const pane = new Pane(body, side, {
    picture: (context) => {
      painting.picture(context, pane.viewport, pane.size);
      if (slots.picture.picture) first?.remove();
    },
    compare: (context) => painting.compare(context, pane.viewport, pane.size, swipe_x()),
    matches: {
      changed: () => painting.changedMatches(pane.viewport, pane.size),
      draw: (context, boxes) => painting.matches(context, boxes),
    },
    live: (context) => layer.paint(context),
  });
  controller.panes[side] = pane;
  const loupe = new Loupe(
    pane,
    (context, viewport, size) => {
      painting.picture(context, viewport, size, "loupe");
      painting.compare(context, viewport, size, swipeInLoupe(pane, swipe_x(), viewport));
    },
    (context, viewport, size) => {
      painting.matchesIn(context, viewport, size);
      painting.live(context, viewport, size, 0, false);
    },
  );
  const layer = new LiveLayer({ controller, pane, painting, tools, loupe });
  const notes = new Notes(controller, pane, slots);
  mountToolbar(controller, pane);
  mountMeasureBar(controller, body);
  listenToPointers(pane, tools, space);
  tools.onPointer((at, uv) => at === pane && readout(pane, uv));
  pane.onMove(() => tools.pictureMoved(pane));
  return { pane, slots, notes };
};
