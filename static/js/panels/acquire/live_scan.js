/** What a run has seen so far, in the scan pane while it goes on; the scan that is open stays below. */

import { store } from "../../net/store.js";
import { acquisitionNow } from "../../state/acquisition.js";
import { element } from "../../ui/dom.js";

const SHOWN_WHILE = ["running", "paused", "fault"];

/** @param {HTMLElement} body of the scan pane */
export const mountLiveScan = (body) => {
  const picture = element("img", { class: "live-scan", alt: "What the run has seen so far, all around", hidden: true });
  body.append(picture);
  store.watch(["acquisition"], () => {
    const { state, picture: rev } = acquisitionNow();
    picture.hidden = !rev || !SHOWN_WHILE.includes(state);
    const address = `picture/acquisition?rev=${rev}`;
    if (!picture.hidden && picture.getAttribute("src") !== address) picture.src = address;
  });
};
