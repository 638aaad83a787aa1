/** The swipe: a bar across the photograph, to the left of which the scan lies over it. */

import { element } from "../ui/dom.js";

const STEP = 0.01;

/** @param {import("./controller.js").Desk} desk */
export const mountSwipe = (desk) => {
  const pane = desk.panes.photo;
  const told = { "aria-label": "Swipe between scan and photograph", "aria-valuemin": 0, "aria-valuemax": 100 };
  const bar = element("div", { class: "pane-swipe", role: "slider", tabIndex: 0, ...told });
  pane.body.append(bar);
  const set = (swipe) => desk.view.set({ photo: { swipe: Math.min(1, Math.max(0, swipe)) } });

  bar.addEventListener("pointerdown", (event) => {
    event.stopPropagation();
    bar.setPointerCapture(event.pointerId);
  });
  bar.addEventListener("pointermove", (event) => {
    if (!bar.hasPointerCapture(event.pointerId)) return;
    event.stopPropagation();
    set(pane.at(event)[0] / pane.size[0]);
  });
  bar.addEventListener("keydown", (event) => {
    const by = { ArrowLeft: -STEP, ArrowDown: -STEP, ArrowRight: STEP, ArrowUp: STEP }[event.key];
    if (!by) return;
    event.preventDefault();
    set(desk.view.get().photo.swipe + by * (event.shiftKey ? 10 : 1));
  });

  const show = () => {
    const { overlay, swipe } = desk.view.get().photo;
    bar.hidden = overlay !== "swipe" || !desk.posed;
    bar.style.setProperty("left", `${100 * swipe}%`);
    bar.setAttribute("aria-valuenow", String(Math.round(100 * swipe)));
  };
  desk.view.on((_, changed) => changed.has("photo") && show());
  desk.store.watch(["poses:*", "shown"], show);
  show();
};
