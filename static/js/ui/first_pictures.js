/** The pictures that the page itself requests, before its scripts. */

import { byId } from "./dom.js";

/** @returns {Promise<void>} resolves once they have arrived or failed: what is larger must not slow them down */
export const whenFirstPicturesArrived = async () => {
  /** @type {NodeListOf<HTMLImageElement>} */
  const pictures = document.querySelectorAll(".first-picture");
  const arrived = [...pictures].map((picture) => picture.complete || new Promise((done) => {
    for (const event of ["load", "error"]) picture.addEventListener(event, done, { once: true });
  }));
  await Promise.all(arrived);
};

const PATIENCE_MS = 10_000;
const FLUENT_MS = 50;
const FLUENT_FRAMES = 4;

/** @returns {Promise<void>} resolves once no first picture is left: the panes paint their own */
const whenReplaced = () =>
  new Promise((done) => {
    const look = () => {
      if (document.querySelector(".first-picture")) return;
      observer.disconnect();
      done();
    };
    const observer = new MutationObserver(look);
    observer.observe(byId("panes"), { childList: true, subtree: true });
    look();
  });

/** @returns {Promise<void>} resolves once frames follow each other quickly */
const whenFluent = () =>
  new Promise((done) => {
    let fluent = 0, before = performance.now();
    /** @param {number} now */
    const frame = (now) => {
      fluent = now - before < FLUENT_MS ? fluent + 1 : 0;
      before = now;
      fluent < FLUENT_FRAMES ? requestAnimationFrame(frame) : done();
    };
    requestAnimationFrame(frame);
  });

/** @type {Promise<void> | null} */
let painted = null;

/**
 * For the 3-D view, which blocks the page while it begins: without a graphics card for as long as the browser still has
 * something else to draw.
 * @returns {Promise<void>} resolves once the panes have painted their pictures, or after a few seconds
 */
export const whenPanesPainted = () => {
  painted ??= Promise.race([
    whenFirstPicturesArrived().then(whenReplaced).then(whenFluent),
    new Promise((done) => setTimeout(done, PATIENCE_MS)), // a hidden tab paints nothing
  ]);
  return painted;
};
