/** Small signs drawn once and then stamped: of five hundred matches, the rings alone would cost more than all else. */

const SIDE_PX = 24;
const TAU = 2 * Math.PI;
const made = new Map();

/** @typedef {{colour: string, halo: string, radius: number, width: number, dash?: number[], dot?: number, cross?: number}} Sign */

const draw = (context, { colour, halo, radius, width, dash = [], dot = 0, cross = 0 }) => {
  const middle = SIDE_PX / 2;
  const path = new Path2D();
  if (radius > 0) path.arc(middle, middle, radius, 0, TAU);
  if (cross > 0) {
    path.moveTo(middle - cross, middle - cross);
    path.lineTo(middle + cross, middle + cross);
    path.moveTo(middle - cross, middle + cross);
    path.lineTo(middle + cross, middle - cross);
  }
  context.lineCap = "round";
  context.lineWidth = width + 2.5;
  context.strokeStyle = halo;
  context.stroke(path);
  context.setLineDash(dash);
  context.lineWidth = width;
  context.strokeStyle = colour;
  context.stroke(path);
  if (dot === 0) return;
  context.beginPath();
  context.arc(middle, middle, dot, 0, TAU);
  context.fillStyle = colour;
  context.fill();
};

/** Signs are made at twice the screen's resolution: they stand between pixels. */
const stampOf = (sign, scale) => {
  const ratio = 2 * scale * (window.devicePixelRatio || 1);
  const key = `${ratio} ${Object.values(sign).join(" ")}`;
  if (!made.has(key)) {
    const canvas = document.createElement("canvas");
    canvas.width = canvas.height = Math.ceil(SIDE_PX * ratio);
    const context = canvas.getContext("2d", { willReadFrequently: true });
    context.scale(ratio, ratio);
    draw(context, sign);
    made.set(key, canvas);
  }
  return made.get(key);
};

/**
 * Put a sign at each place.
 * @param {CanvasRenderingContext2D} context in CSS pixels
 * @param {{scale: number}} look
 * @param {number[][]} places
 * @param {Sign} sign
 */
export const stamp = (context, look, places, sign) => {
  if (places.length === 0) return;
  const canvas = stampOf(sign, look.scale);
  const side = SIDE_PX * look.scale;
  context.imageSmoothingEnabled = true;
  for (const [x, y] of places) context.drawImage(canvas, x - side / 2, y - side / 2, side, side);
};
