/** The numbers of matches, beside their ends. */

import { colourOf } from "./colors.js";

const LABEL = { width: 24, dx: 8, dy: -8 };
const KEPT_FREE_PX = 7;

/** Write a number upon its halo. */
const drawLabel = (context, look, colour, text, [x, y]) => {
  context.lineWidth = 3.5 * look.scale;
  context.strokeStyle = look.halo;
  context.strokeText(text, x, y);
  context.fillStyle = colour;
  context.fillText(text, x, y);
};

/** Where a match's number stands: above its first visible end, away from its line. */
const labelPlace = ({ ends, line }, scale) => {
  const at = ends.find(Boolean) ?? line?.[0];
  if (!at) return null;
  const far = line && (Math.hypot(line[1][0] - at[0], line[1][1] - at[1]) > 1 ? line[1] : line[0]);
  const rightwards = far && far[0] > at[0] && far[1] < at[1];
  return [at[0] + (rightwards ? -LABEL.dx - 9 : LABEL.dx) * scale, at[1] + LABEL.dy * scale];
};

/** Numbers where there is room for them: neither upon each other, nor upon the end of another match. */
export const drawLabels = (context, shown, look) => {
  const { scale } = look;
  const cell = LABEL.width * scale;
  const taken = new Map();
  const cellsOf = ([left, top, right, bottom]) => {
    const cells = [];
    for (let x = Math.floor(left / cell); x <= Math.floor(right / cell); x++) {
      for (let y = Math.floor(top / cell); y <= Math.floor(bottom / cell); y++) cells.push(`${x},${y}`);
    }
    return cells;
  };
  const take = (box, owner) => {
    for (const name of cellsOf(box)) {
      if (!taken.has(name)) taken.set(name, []);
      taken.get(name).push([box, owner]);
    }
  };
  const isFree = (box, owner) =>
    cellsOf(box).every((name) =>
      (taken.get(name) ?? []).every(
        ([other, of]) => of === owner || other[0] >= box[2] || box[0] >= other[2] || other[1] >= box[3] || box[1] >= other[3],
      ),
    );
  const reach = KEPT_FREE_PX * scale;
  for (const { mark, ends } of shown) {
    for (const [x, y] of ends.filter(Boolean)) take([x - reach, y - reach, x + reach, y + reach], mark.id);
  }
  context.font = look.font;
  context.textBaseline = "alphabetic";
  context.lineJoin = "round";
  const linesFirst = [...shown].sort((a, b) => a.mark.kind.localeCompare(b.mark.kind));
  for (const entry of linesFirst) {
    const place = labelPlace(entry, scale);
    if (!place) continue;
    const text = String(entry.mark.number);
    const box = [place[0], place[1] - 10 * scale, place[0] + 8 * scale * text.length, place[1]];
    if (entry.mark.kind === "point" && !isFree(box, entry.mark.id)) continue;
    take(box, entry.mark.id);
    drawLabel(context, look, colourOf(look, entry.mark.number), text, place);
  }
};

/** Write the number of one match, whatever lies below. */
export const drawNumber = (context, entry, look) => {
  const place = labelPlace(entry, look.scale);
  if (!place) return;
  context.font = look.font;
  context.lineJoin = "round";
  drawLabel(context, look, colourOf(look, entry.mark.number), String(entry.mark.number), place);
};
