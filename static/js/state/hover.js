/** A match that is touched anywhere is lit everywhere: from the 3-D scene into the page, and from the page into it. */

import { ask, connectionState } from "../net/connection.js";
import { store } from "../net/store.js";
import { view } from "./view.js";

const APART_MS = 80;

/** Link both ways from now on. */
export const linkHovering = () => {
  let told = null;
  let timer = 0;
  store.onEvent("hover", ({ photo, pick }) => {
    if (photo && photo !== store.shown()) return;
    told = pick ?? null; // it comes from there: it is not told back
    view.set({ hovered: told });
  });
  const tell = () => {
    timer = 0;
    const { hovered } = view.get();
    if (hovered === told || connectionState() !== "connected") return;
    told = hovered;
    ask("hover_pick", { pick: hovered }).catch(() => {}); // a light that does not go on is no loss
  };
  view.on((_, changed) => {
    if (changed.has("hovered")) timer ||= setTimeout(tell, APART_MS);
  });
};
