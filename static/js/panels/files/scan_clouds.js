/** The clouds of the open scan, in the dialog for opening files and in the head of its pane: more can be added. */

import { store } from "../../net/store.js";
import { cloudNames, scanName } from "../../state/scan_name.js";
import { button } from "../../ui/controls.js";
import { element, partOf, setText } from "../../ui/dom.js";
import { icon } from "../../ui/icons.js";
import { counted } from "../../ui/numbers.js";

/** What frames are, for tooltips and hints. */
export const ABOUT_FRAMES =
  "further clouds that the scanner took at rest from the same standpoint. They are accumulated with the scan; matches, photographs and poses stay.";

/**
 * @param {() => void} add asks for further clouds
 * @returns {HTMLElement} hidden where no scan is open
 */
export const scanClouds = (add) => {
  const name = element("span", { class: "clip" });
  const count = element("span", { class: "dim" });
  const more = button({ label: "Add frames…", kind: "small edits", icon: "plus", title: `Add ${ABOUT_FRAMES}`, act: add });
  const section = element(
    "section",
    { class: "served", "aria-label": "The open scan" },
    element("h3", {}, "Open scan"),
    element("div", { class: "file-row scan-row" }, icon("file"), name, count, more),
  );
  const show = () => {
    const scan = store.get("scan");
    section.hidden = !scan;
    if (!scan) return;
    setText(name, scanName(scan));
    name.title = cloudNames(scan);
    setText(count, scan.files.length > 1 ? counted(scan.files.length, "cloud") : "");
  };
  store.watch(["scan"], show);
  show();
  return section;
};

/**
 * Put a button into the head of the scan's pane that says of how many clouds the scan consists, and asks for more.
 * @param {HTMLElement} head
 * @param {() => void} add
 */
export const mountFramesButton = (head, add) => {
  const more = button({ label: "Add frames", text: "Frames", icon: "plus", kind: "pane-button frames-button edits", act: add });
  partOf(head, ".pane-zooms").before(more);
  const show = () => {
    const scan = store.get("scan");
    const clouds = scan?.files.length ?? 0;
    const several = clouds > 1;
    more.hidden = !scan || Boolean(scan.error);
    more.classList.toggle("several", several);
    setText(partOf(more, "span"), several ? counted(clouds, "cloud") : "Frames");
    more.title = `${several ? `${cloudNames(scan)}\n` : ""}Add ${ABOUT_FRAMES}`;
  };
  store.watch(["scan"], show);
  show();
};
