/** Pictures from the workbench: fetched, decoded, and an error that says what to do. */

/**
 * @param {string} address relative to the page
 * @returns {Promise<ImageBitmap>} rejects with an Error whose message is one sentence
 */
export const loadBitmap = async (address) => {
  let answer;
  try {
    answer = await fetch(address);
  } catch {
    throw new Error("The picture could not be loaded: check that the workbench is running. It is loaded again when the connection is back.");
  }
  if (!answer.ok) {
    const text = (await answer.text()).trim();
    const plain = text && text.length < 300 && !text.startsWith("<");
    throw new Error(plain ? text : `The picture could not be loaded (status ${answer.status}): reload the page.`);
  }
  try {
    return await createImageBitmap(await answer.blob());
  } catch {
    throw new Error("This browser cannot decode the picture, which may be too large for it: use another browser or a smaller picture.");
  }
};
