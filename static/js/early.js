/**
 * What is begun as soon as the few modules that it needs are there, while the rest of the page is still being loaded: the
 * connection, and, after the two pictures, viser's page, by far the largest file, which its frame then finds in the cache.
 */

import { connectEarly } from "./net/connection.js";
import { whenFirstPicturesArrived } from "./ui/first_pictures.js";

connectEarly();
/** @type {HTMLMetaElement | null} */
const meta = document.querySelector('meta[name="viewer"]');
const viewer = meta?.content;
if (viewer && document.querySelector(".first-picture")) {
  whenFirstPicturesArrived()
    .then(() => fetch(viewer, { priority: "high" }))
    .then((answer) => answer.blob())
    .catch(() => {}); // the frame tries again, and says what is wrong
}
