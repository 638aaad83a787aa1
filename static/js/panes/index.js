/** The two image panes: scan and photograph side by side, and the drawing of matches in them. */

import { Desk } from "./controller.js";
import { listenToKeys } from "./keyboard.js";
import { linkPanes } from "./linked_views.js";
import { onePane } from "./pane_setup.js";
import { mountPhotoHead } from "./photo_head.js";
import { readoutOf } from "./readout.js";
import { listenToReveals } from "./reveal.js";
import { Running } from "./simplex_preview.js";
import { mountScanHead } from "./scan_head.js";
import { Strokes } from "./tools.js";
import { mountSwipe } from "./swipe.js";

const SIDES = ["scan", "photo"];
const PICTURES_APART_MS = 180;

/**
 * Fill the two image panes.
 * @param {{scanHead: HTMLElement, scanBody: HTMLElement, photoHead: HTMLElement, photoBody: HTMLElement,
 *          store: import("../net/store.js").Store, view: any, ask: (what: string, args?: any) => Promise<any>}} page
 */
export const mountPanes = ({ scanHead, scanBody, photoHead, photoBody, store, view, ask }) => {
  const desk = new Desk({ store, view, ask });
  const strokes = new Strokes(desk);
  const space = { held: false, used: false };
  const running = new Running(store, (began) => {
    desk.panes.photo?.invalidate("live");
    if (began) desk.panes.photo?.invalidate("matches");
  });
  const shared = { desk, strokes, running, space, readout: readoutOf(desk) };
  const bodies = { scan: scanBody, photo: photoBody };
  const built = Object.fromEntries(SIDES.map((side) => [side, onePane(bodies[side], side, shared)]));
  const controlsOf = (head) => head.querySelector(".pane-controls") ?? head;
  mountScanHead(controlsOf(scanHead), desk);
  mountPhotoHead(controlsOf(photoHead), desk);
  mountSwipe(desk);
  linkPanes(desk);
  listenToKeys(desk, strokes, space);
  listenToReveals(desk);

  const notesShown = () => SIDES.forEach((side) => built[side].notes.show());
  desk.onTaken = notesShown;

  /** Ask for what is to be shown now; of pictures that a slider asks for, a few a second. */
  let timer = 0;
  const askForPictures = () => {
    timer = 0;
    for (const side of SIDES) built[side].slots.picture.show(desk.sides[side].address, desk.sides[side].pictured);
    built.photo.slots.compare.show(desk.sides.photo.overlayAddress);
  };
  const picturesSoon = () => {
    timer ||= setTimeout(askForPictures, PICTURES_APART_MS);
  };

  const things = {};
  const takeSlices = () => {
    for (const side of SIDES) {
      const { thing, extent } = desk.sides[side];
      if (thing !== things[side]) {
        desk.picking.forget(side);
        desk.cursor = null;
      }
      desk.panes[side].setExtent(extent);
      things[side] = thing;
    }
    askForPictures();
    desk.changed();
    desk.hint();
    notesShown();
  };
  store.watch(["scan", "photos", "shown", "poses:*"], takeSlices);
  store.watch(["picks:*", "judged:*", "corners:*"], () => {
    desk.arrived();
    desk.changed();
  });

  const filters = (state) => {
    for (const side of SIDES) {
      bodies[side].style.setProperty("--lr-brightness", state[side].brightness);
      bodies[side].style.setProperty("--lr-contrast", state[side].contrast);
      // A filter that changes nothing would still be worked out for every frame.
      bodies[side].classList.toggle("lit", state[side].brightness !== 1 || state[side].contrast !== 1);
    }
  };
  let shownView = desk.sides.scan.index;
  view.on((state, changed) => {
    if (changed.has("scan") || changed.has("photo")) filters(state);
    if (changed.has("scan")) {
      if (desk.sides.scan.index !== shownView) {
        desk.picking.dropStroke("scan");
        takeSlices();
      } else picturesSoon();
      shownView = desk.sides.scan.index;
    }
    if (changed.has("photo")) {
      picturesSoon();
      desk.panes.photo.invalidate("compare");
    }
    if (changed.has("tool")) {
      if (desk.picking.drawing) desk.picking.abandon();
      desk.took("nothing");
    }
    if (["hovered", "selected", "end", "loupe", "snap"].some((name) => changed.has(name))) desk.redraw("live");
    if (changed.has("corners")) desk.redraw("matches");
  });
  filters(view.get());
  takeSlices();
};
