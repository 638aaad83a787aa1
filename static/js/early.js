/**
 * What is begun as soon as the few modules that it needs are there, while the rest of the page is still being loaded: the
 * connection, and, after the two pictures and all scripts, viser's page, by far the largest file, which its frame then
 * finds in the cache.
 */

import { connectEarly } from "./net/connection.js";
import { whenFirstPicturesArrived } from "./ui/first_pictures.js";

connectEarly();
/** @type {HTMLMetaElement | null} */
const meta = document.querySelector('meta[name="viewer"]');
const viewer = meta?.content;
if (viewer && document.querySelector(".first-picture")) {
  const assembled = new Promise((done) => addEventListener("DOMContentLoaded", done, { once: true }));
  Promise.all([whenFirstPicturesArrived(), assembled])
    .then(() => fetch(viewer, { priority: "high" }))
    .then((answer) => answer.blob())
    .catch(() => {}); // the frame tries again, and says what is wrong
}
