/**
 * Colours and sizes of what is drawn over the pictures. The halo is dark in both themes, since it lies on a picture.
 */

const MATCH_COLOURS = 6;
const PEOPLE_COLOURS = 6;

const ROOT_PX = 13;

/**
 * @typedef {{matches: string[], people: string[], ink: string, dim: string, warn: string, bad: string, halo: string, font: string, scale: number}} Look
 *   `scale` multiplies strokes and symbols: they grow with the page's font size on very large screens
 */

/** @returns {Look} */
export const readLook = () => {
  const tokens = getComputedStyle(document.documentElement);
  const scale = (Number.parseFloat(tokens.fontSize) || ROOT_PX) / ROOT_PX;
  /** @param {string} name */
  const token = (name) => tokens.getPropertyValue(`--lr-${name}`).trim();
  return {
    matches: Array.from({ length: MATCH_COLOURS }, (_, k) => token(`match-${k + 1}`)),
    people: Array.from({ length: PEOPLE_COLOURS }, (_, k) => token(`person-${k + 1}`)),
    ink: "#ffffff",
    dim: "#c3ccd8",
    warn: "#f2b84b",
    bad: "#f2726f",
    halo: "rgba(6, 8, 12, .82)",
    font: `600 ${12 * scale}px ${token("font") || "sans-serif"}`,
    scale,
  };
};

/** @param {Pick<Look, "matches">} look @param {number} number @returns {string} the colour of a match; numbers start at 1 */
export const colourOf = (look, number) => look.matches[(number - 1) % MATCH_COLOURS];
