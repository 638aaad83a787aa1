/** The pictures that the page itself requests, before its scripts. */

/** @returns {Promise<void>} resolves once they have arrived or failed: what is larger must not slow them down */
export const whenFirstPicturesArrived = async () => {
  const arrived = (picture) =>
    picture.complete ||
    new Promise((done) => ["load", "error"].forEach((event) => picture.addEventListener(event, done, { once: true })));
  await Promise.all([...document.querySelectorAll(".first-picture")].map(arrived));
};
