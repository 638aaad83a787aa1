/**
 * The viewport: position and zoom of a picture in its pane. Pixel u is shown at (u + .5) * zoom + x CSS pixels from the
 * pane's left border; (0, 0) is the centre of the top-left pixel. Viewports are immutable.
 */

/**
 * @typedef {{zoom: number, x: number, y: number}} Viewport
 * @typedef {[number, number]} Pair
 * @typedef {readonly number[]} Size width and height
 */

export const LARGEST_ZOOM = 64;
/** From this zoom on, pixels are shown without smoothing. */
export const SMOOTH_BELOW = 2;
const SMALLEST_OF_FIT = 0.25;
const MIN_VISIBLE_PX = 48;
const WHEEL_LINE_PX = 16;
const WHEEL_PAGE_PX = 400;
const FASTEST_WHEEL_PX = 240;
const WHEEL_RATE = 0.0022;
const PINCH_RATE = 0.012;

/** @param {Viewport} viewport @param {readonly number[]} uv @returns {Pair} position of pixel uv in the pane */
export const toScreen = (viewport, uv) => [
  (uv[0] + 0.5) * viewport.zoom + viewport.x,
  (uv[1] + 0.5) * viewport.zoom + viewport.y,
];

/** @param {Viewport} viewport @param {readonly number[]} xy @returns {Pair} the pixel at a position of the pane */
export const toPixel = (viewport, xy) => [
  (xy[0] - viewport.x) / viewport.zoom - 0.5,
  (xy[1] - viewport.y) / viewport.zoom - 0.5,
];

/** @param {Size} pane @param {Size} picture @returns {Viewport} the whole picture, as large as possible, centred */
export const fitted = (pane, picture) => {
  const zoom = Math.min(pane[0] / picture[0], pane[1] / picture[1], LARGEST_ZOOM);
  return { zoom, x: (pane[0] - picture[0] * zoom) / 2, y: (pane[1] - picture[1] * zoom) / 2 };
};

/** @param {number} zoom @param {Size} pane @param {Size} picture @returns {number} the zoom, limited to the allowed range */
export const allowed = (zoom, pane, picture) =>
  Math.min(LARGEST_ZOOM, Math.max(zoom, SMALLEST_OF_FIT * Math.min(1, fitted(pane, picture).zoom)));

/**
 * @param {Viewport} viewport
 * @param {readonly number[]} xy
 * @param {number} zoom
 * @returns {Viewport} with another zoom; the point at xy stays in place
 */
export const zoomedAbout = (viewport, xy, zoom) => {
  const factor = zoom / viewport.zoom;
  return { zoom, x: xy[0] + (viewport.x - xy[0]) * factor, y: xy[1] + (viewport.y - xy[1]) * factor };
};

/** @param {Viewport} viewport @param {readonly number[]} by @returns {Viewport} moved by CSS pixels */
export const moved = (viewport, by) => ({ zoom: viewport.zoom, x: viewport.x + by[0], y: viewport.y + by[1] });

/**
 * @param {readonly number[]} uv
 * @param {number} zoom
 * @param {Size} pane
 * @returns {Viewport} with pixel uv in the centre of the pane
 */
export const centredOn = (uv, zoom, pane) => ({
  zoom,
  x: pane[0] / 2 - (uv[0] + 0.5) * zoom,
  y: pane[1] / 2 - (uv[1] + 0.5) * zoom,
});

/** @param {Viewport} viewport @param {Size} pane @returns {Pair} the pixel in the centre of the pane */
export const middle = (viewport, pane) => toPixel(viewport, [pane[0] / 2, pane[1] / 2]);

/**
 * @param {Viewport} viewport
 * @param {Size} pane
 * @param {Size} picture
 * @returns {Viewport} moved so that some of the picture stays visible
 */
export const keptInSight = (viewport, pane, picture) => {
  /** @param {number} at @param {number} room @param {number} length */
  const along = (at, room, length) => {
    const least = Math.min(MIN_VISIBLE_PX, length, room / 2);
    return Math.min(Math.max(at, least - length), room - least);
  };
  return {
    zoom: viewport.zoom,
    x: along(viewport.x, pane[0], picture[0] * viewport.zoom),
    y: along(viewport.y, pane[1], picture[1] * viewport.zoom),
  };
};

/**
 * Zoom factor of a wheel event: a notch zooms by about a quarter, trackpads smoothly, a pinch follows the fingers.
 * @param {{deltaY: number, deltaMode: number, ctrlKey: boolean}} wheel
 * @returns {number} factor
 */
export const wheelFactor = ({ deltaY, deltaMode, ctrlKey }) => {
  const px = deltaY * (deltaMode === 1 ? WHEEL_LINE_PX : deltaMode === 2 ? WHEEL_PAGE_PX : 1);
  const bounded = Math.max(-FASTEST_WHEEL_PX, Math.min(FASTEST_WHEEL_PX, px));
  // browsers report a pinch as a wheel with Ctrl in small steps; a real wheel with Ctrl has large ones
  const rate = ctrlKey && Math.abs(bounded) < 50 ? PINCH_RATE : WHEEL_RATE;
  return Math.exp(-bounded * rate);
};

/** @param {(readonly number[])[]} uvs @param {number} axis */
const extent = (uvs, axis) => {
  const values = uvs.map((uv) => uv[axis]);
  return [Math.min(...values), Math.max(...values)];
};

/**
 * Make pixels visible: nothing moves while they are well inside, and the zoom changes only if it must.
 * @param {Viewport} viewport
 * @param {Size} pane
 * @param {(readonly number[])[]} uvs at least one
 * @param {number} least the zoom below which a single point is hard to see
 * @returns {Viewport}
 */
export const revealing = (viewport, pane, uvs, least = 1) => {
  const [left, right] = extent(uvs, 0);
  const [top, bottom] = extent(uvs, 1);
  const most = Math.min((pane[0] * 0.8) / Math.max(right - left, 1), (pane[1] * 0.8) / Math.max(bottom - top, 1));
  const wanted = Math.max(viewport.zoom, Math.min(least, most));
  const zoom = Math.min(wanted, most, LARGEST_ZOOM);
  const inside = uvs.every((uv) => {
    const [x, y] = toScreen(viewport, uv);
    return x >= pane[0] * 0.08 && x <= pane[0] * 0.92 && y >= pane[1] * 0.08 && y <= pane[1] * 0.92;
  });
  if (inside && zoom === viewport.zoom) return viewport;
  return centredOn([(left + right) / 2, (top + bottom) / 2], zoom, pane);
};

/**
 * @param {Viewport} viewport
 * @param {Size} pane
 * @param {Size} picture
 * @returns {Viewport} moved so that a picture larger than the pane leaves no border in it; a smaller one is centred
 */
export const filling = (viewport, pane, picture) => {
  /** @param {number} at @param {number} room @param {number} length */
  const along = (at, room, length) => (length < room ? (room - length) / 2 : Math.min(0, Math.max(at, room - length)));
  return {
    zoom: viewport.zoom,
    x: along(viewport.x, pane[0], picture[0] * viewport.zoom),
    y: along(viewport.y, pane[1], picture[1] * viewport.zoom),
  };
};

/**
 * @param {Viewport} a
 * @param {Viewport} b
 * @returns {boolean} whether two viewports show the same to within half a pixel of the screen
 */
export const showSame = (a, b) => Math.abs(a.zoom / b.zoom - 1) < 1e-6 && Math.abs(a.x - b.x) < 0.5 && Math.abs(a.y - b.y) < 0.5;

/**
 * @param {Viewport} from
 * @param {Viewport} to
 * @param {number} t
 * @param {Size} pane
 * @returns {Viewport} interpolated between two viewports: 0 <= t <= 1
 */
export const between = (from, to, t, pane) => {
  if (t >= 1) return to;
  const zoom = Math.exp(Math.log(from.zoom) * (1 - t) + Math.log(to.zoom) * t);
  const [a, b] = [middle(from, pane), middle(to, pane)];
  // along the zoom, not along the time: otherwise the target would leave the pane while zooming in
  const share = from.zoom === to.zoom ? t : (1 / zoom - 1 / from.zoom) / (1 / to.zoom - 1 / from.zoom);
  return centredOn([a[0] + (b[0] - a[0]) * share, a[1] + (b[1] - a[1]) * share], zoom, pane);
};

/** @param {readonly number[]} uv @param {Size} picture @returns {Pair} the nearest pixel inside the picture */
export const inside = (uv, picture) => [
  Math.min(Math.max(uv[0], 0), picture[0] - 1),
  Math.min(Math.max(uv[1], 0), picture[1] - 1),
];

/** @param {readonly number[]} uv @param {Size} picture @returns {number} distance of uv from the picture in pixels; 0 inside */
export const outsideBy = (uv, picture) => Math.max(-0.5 - uv[0], -0.5 - uv[1], uv[0] - picture[0] + 0.5, uv[1] - picture[1] + 0.5, 0);

/** @param {number} zoom @returns {string} such as `68 %` or `×12` */
export const zoomText = (zoom) => {
  if (zoom >= 10) return `×${zoom.toFixed(zoom % 1 < 0.05 ? 0 : 1)}`;
  return `${(100 * zoom).toFixed(zoom < 0.1 ? 1 : 0)} %`;
};
