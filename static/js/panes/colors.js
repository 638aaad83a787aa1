/** The overlays' colours, from the page's tokens. They lie on pictures, so that their halo is dark in either theme. */

const MATCH_COLOURS = 6;

const ROOT_PX = 13;

/**
 * @returns {{matches: string[], ink: string, dim: string, warn: string, halo: string, font: string, scale: number}}
 *   `scale`: of strokes and signs; the page's sizes grow with very large screens, and theirs with them
 */
export const readLook = () => {
  const tokens = getComputedStyle(document.documentElement);
  const scale = (Number.parseFloat(tokens.fontSize) || ROOT_PX) / ROOT_PX;
  const token = (name) => tokens.getPropertyValue(`--lr-${name}`).trim();
  return {
    matches: Array.from({ length: MATCH_COLOURS }, (_, k) => token(`match-${k + 1}`)),
    ink: "#ffffff",
    dim: "#c3ccd8",
    warn: "#f2b84b",
    halo: "rgba(6, 8, 12, .82)",
    font: `600 ${12 * scale}px ${token("font") || "sans-serif"}`,
    scale,
  };
};

/** @returns {string} the colour of a match by its number, from 1 */
export const colourOf = (look, number) => look.matches[(number - 1) % MATCH_COLOURS];
