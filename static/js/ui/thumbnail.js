/** The small picture of a photograph in a list. */

import { element } from "./dom.js";
import { icon } from "./icons.js";

/**
 * The small picture of a photograph, which is fetched once the list shows it.
 * @param {{id: string, rev?: string, error?: string}} photo
 * @returns {HTMLElement}
 */
export const thumbnail = ({ id, rev, error }) =>
  error
    ? element("span", { class: "photo-thumbnail" }, icon("bad"))
    : element("img", {
      class: "photo-thumbnail",
      src: `picture/photo/${encodeURIComponent(id)}?rev=${encodeURIComponent(rev ?? id)}&form=small`,
      alt: "",
      loading: "lazy",
    });
