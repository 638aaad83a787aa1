/** A rough pose given by hand: the 3-D view as the camera, from which the registration starts. */

import { requestForPhoto } from "../../net/requests.js";
import { store } from "../../net/store.js";
import { isRunning } from "../../state/pipeline.js";
import { button } from "../../ui/controls.js";
import { element } from "../../ui/dom.js";

/**
 * The controls of the rough pose, for the sheet of the 3-D view's settings.
 * @param {HTMLElement} sheet closed once the registration has started
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
  const show = () => {
    const photo = (store.get("photos") ?? []).find(({ id }) => id === store.shown());
    const missing = !store.get("scan")
      ? "Open a scan first"
      : !photo?.camera
        ? "Needs a photograph with a known focal length"
        : isRunning(store.get("job"))
          ? "A job is running"
          : "";
    refine.disabled = Boolean(missing);
    refine.title = missing;
  };
  store.watch(["scan", "photos", "shown", "job"], show);
  show();
  return element(
    "section",
    { class: "rough-pose", "aria-label": "Rough pose" },
    element("h3", {}, "Rough pose"),
    element(
      "p",
      {},
      "Move the 3-D view to about where the camera stood, until it looks like the photograph. The registration then " +
        "starts from this view, with the photograph's own camera.",
    ),
    refine,
  );
};
