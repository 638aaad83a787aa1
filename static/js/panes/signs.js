/** Small things drawn over a picture that are no matches: corners, crosshair, the corner that an end goes to, a frame. */

import { strokeHaloed } from "./match_layer.js";
import { toScreen } from "./viewport.js";

/** Draw corners that were found: small plus signs. */
export const drawCorners = (context, viewport, size, corners, look) => {
  const path = new Path2D();
  const reach = 3 * look.scale;
  for (const uv of corners) {
    const [x, y] = toScreen(viewport, uv);
    if (x < -reach || y < -reach || x > size[0] + reach || y > size[1] + reach) continue;
    path.moveTo(x - reach, y);
    path.lineTo(x + reach, y);
    path.moveTo(x, y - reach);
    path.lineTo(x, y + reach);
  }
  context.lineCap = "butt";
  context.lineWidth = 3 * look.scale;
  context.strokeStyle = "rgba(6, 8, 12, .6)";
  context.stroke(path);
  context.lineWidth = look.scale;
  context.strokeStyle = look.dim;
  context.stroke(path);
};

/** Draw a crosshair: where the keyboard stands. */
export const drawCrosshair = (context, [x, y], look, reach = 12) => {
  const path = new Path2D();
  for (const [dx, dy] of [[-1, 0], [1, 0], [0, -1], [0, 1]]) {
    path.moveTo(x + dx * 3 * look.scale, y + dy * 3 * look.scale);
    path.lineTo(x + dx * reach * look.scale, y + dy * reach * look.scale);
  }
  strokeHaloed(context, path, look, { colour: look.ink, width: 1.25 });
};

/** Draw the corner that an end would go to: a small diamond. */
export const drawSnap = (context, [x, y], look) => {
  const path = new Path2D();
  const reach = 6 * look.scale;
  path.moveTo(x - reach, y);
  path.lineTo(x, y - reach);
  path.lineTo(x + reach, y);
  path.lineTo(x, y + reach);
  path.closePath();
  strokeHaloed(context, path, look, { colour: look.warn, width: 1.5 });
};

/** Draw the frame of a selection being made. */
export const drawFrame = (context, a, b, look) => {
  const path = new Path2D();
  path.rect(Math.min(a[0], b[0]), Math.min(a[1], b[1]), Math.abs(a[0] - b[0]), Math.abs(a[1] - b[1]));
  strokeHaloed(context, path, look, { colour: look.ink, width: 1, dash: [4, 3] });
};
