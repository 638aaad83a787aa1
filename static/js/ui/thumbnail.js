/** The small picture of a photograph in a list. */

import { element } from "./dom.js";
import { icon } from "./icons.js";

const AHEAD = "160px";

/** Thumbnails are fetched once they are in sight: `loading="lazy"` alone fetches eighty of them as soon as a list opens. */
const observer = new IntersectionObserver(
  (entries) => {
    for (const { target, isIntersecting } of entries) {
      if (!isIntersecting) continue;
      const picture = /** @type {HTMLImageElement} */ (target);
      observer.unobserve(picture);
      picture.src = picture.dataset.src ?? "";
    }
  },
  { rootMargin: AHEAD },
);

/**
 * The small picture of a photograph, which is fetched once the list shows it.
 * @param {{id: string, rev?: string, error?: string}} photo
 * @returns {HTMLElement}
 */
export const thumbnail = ({ id, rev, error }) => {
  if (error) return element("span", { class: "photo-thumbnail" }, icon("bad"));
  const picture = element("img", { class: "photo-thumbnail", alt: "" });
  picture.dataset.src = `picture/photo/${encodeURIComponent(id)}?rev=${encodeURIComponent(rev ?? id)}&form=small`;
  observer.observe(picture);
  return picture;
};
