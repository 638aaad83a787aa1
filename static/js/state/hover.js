/** Hovering over a match highlights it everywhere: in the table, the plots, both pictures and the 3-D scene. */

import { ask, connectionState } from "../net/connection.js";
import { store } from "../net/store.js";
import { throttled } from "../ui/throttle.js";
import { view } from "./view.js";

const INTERVAL_MS = 80;

/** Link the page's hovering with that of the 3-D scene, both ways. */
export const linkHovering = () => {
  /** @type {string | null} to the scene: what came from it is not sent back */
  let known = null;
  store.onEvent("hover", ({ client, pick }) => {
    if (client !== store.get("people")?.you) return;
    known = pick ?? null;
    view.set({ hovered: known });
  });
  const send = throttled(async () => {
    const { hovered } = view.get();
    if (hovered === known || connectionState() !== "connected") return;
    known = hovered;
    await ask("hover_pick", { pick: hovered });
  }, INTERVAL_MS);
  view.on((_, changed) => changed.has("hovered") && send());
};
