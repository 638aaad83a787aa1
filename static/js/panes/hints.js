/** What the tool in hand expects next, in one sentence. */

import { other } from "./picking.js";

const PANE = { scan: "scan", photo: "photograph" };

/**
 * @param {import("./picking.js").Picking} picking
 * @param {string} tool
 * @returns {string} for the status bar
 */
export const hintOf = (picking, tool) => {
  const { drawing, open } = picking;
  if (drawing?.clicked) return "Click where the line ends · Esc drops it";
  if (drawing) return drawing.kind === "line" ? "Release where the line ends · Esc drops it" : "Release on the point · Esc drops it";
  if (open) return wantedHint(picking);
  if (tool === "line") return "Draw a line in either picture: drag, or click both ends";
  if (tool === "point") return "Click a point in either picture";
  return "Click a match to select it, drag an end to move it, arrow keys move it by 0.1 px";
};

/** @returns {string} for the pane where the partner is wanted */
export const wantedHint = ({ open, acceptable }) => {
  const where = `Draw the same ${open.kind} in the ${PANE[other(open.side)]}`;
  return acceptable ? `${where}, or Enter takes the dashed one · Esc drops it` : `${where} · Esc drops it`;
};
