/** The head of the photograph's pane: its light, and the scan laid over it. */

import { element } from "../ui/dom.js";
import { button, choice, fill, foldOut, press, slider } from "../ui/controls.js";
import { icon } from "./tool_icons.js";
import { zoomControls } from "./zoom_head.js";

const OVERLAYS = [["none", "No overlay"], ["blend", "Blend"], ["swipe", "Swipe"], ["checker", "Squares"], ["edges", "Edges"]];
const SLID = { blend: ["blend", "Share of the scan"], edges: ["blend", "Strength of the edges"], swipe: ["swipe", "Where the swipe stands"] };

const times = (value) => `×${value.toFixed(2)}`;

/** @param {HTMLElement} head @param {import("./controller.js").Desk} desk */
export const mountPhotoHead = (head, desk) => {
  const { view, store } = desk;
  const set = (patch) => view.set({ photo: patch });
  const overlay = choice("The scan over the photograph", (name) => set({ overlay: name }));
  const share = element("input", { type: "range", class: "pane-share", min: 0, max: 1, step: 0.01 });
  share.addEventListener("input", () => set({ [SLID[view.get().photo.overlay][0]]: Number(share.value) }));
  const rows = {
    brightness: slider({ label: "Brightness", least: 0.3, most: 3, step: 0.05, text: times, changed: (brightness) => set({ brightness }) }),
    contrast: slider({ label: "Contrast", least: 0.3, most: 3, step: 0.05, text: times, changed: (contrast) => set({ contrast }) }),
  };
  const plain = button("As at first", "Brightness and contrast as at first", () => set({ brightness: 1, contrast: 1 }));
  const { opener, sheet } = foldOut("Light", "Brightness and contrast of the photograph", rows.brightness.row, rows.contrast.row, plain);
  const linked = button("Linked", "", () => view.set({ linked: !view.get().linked }), icon("link"), element("span", {}, "Linked"));
  const zoom = zoomControls(desk, "photo");
  head.append(overlay, share, opener, sheet, linked, zoom.element);

  const show = () => {
    const { photo, linked: together } = view.get();
    const { posed } = desk;
    fill(overlay, OVERLAYS, posed ? photo.overlay : "none");
    overlay.disabled = !posed;
    overlay.title = posed ? "The scan over the photograph" : "The scan can be laid over the photograph once a pose is shown";
    const slid = posed && SLID[photo.overlay];
    share.hidden = !slid;
    if (slid) {
      share.value = photo[slid[0]];
      share.setAttribute("aria-label", slid[1]);
      share.title = slid[1];
    }
    rows.brightness.show(photo.brightness);
    rows.contrast.show(photo.contrast);
    opener.disabled = !store.photo();
    linked.disabled = !posed;
    press(linked, posed && together);
    linked.title = posed ? "Both panes show the same place (K)" : "Both panes can show the same place once a pose is shown";
  };
  view.on((_, changed) => (changed.has("photo") || changed.has("linked")) && show());
  store.watch(["photos", "shown", "poses:*"], show);
  show();
};
