/**
 * The dividers between the panes and above the dock: moved by pointer or arrow keys, reset by a double click. Those that
 * nobody has moved stand where the two pictures fill their panes.
 */

import { store } from "../net/store.js";
import { view } from "../state/view.js";
import { element, partOf } from "../ui/dom.js";

const EMPTY = { left: 0.325, middle: 0.325, dock: 0.33 };
const MODEL_SHARE = 0.32; // of the width
const MIN_MODEL_PX = 365; // its controls fit beside each other
const MIN_PICTURE = 0.2;
const MAX_DOCK_OF_ITSELF = 0.46;
const STEP = 0.02;
const LABELS = { left: "Width of the scan pane", middle: "Width of the photograph pane", dock: "Height of the lower panels" };
/** @type {Record<string, number>} */
const DIRECTIONS = { ArrowLeft: -1, ArrowRight: 1, ArrowUp: 1, ArrowDown: -1 };

const MIN_PANE = 0.12;
const MIN_DOCK = 0.08;
const MAX_DOCK = 0.8;

/** @param {number} value @param {number} least @param {number} most */
const clamp = (value, least, most) => Math.min(most, Math.max(least, value));

/**
 * @typedef {"left" | "middle" | "dock"} Divider
 * @typedef {Record<Divider, number>} Shares of the window
 */

/**
 * Compute the shares at which pictures fill their panes without borders, as large as the window permits.
 * @param {{width: number, height: number}} area of panes and dock, px
 * @param {number} heads height of what is above a picture in its pane, px
 * @param {number[]} aspects width by height of the scan's picture and the photograph
 * @returns {Shares}
 */
export const sharesFor = ({ width, height }, heads, [scan, photo]) => {
  const pictures = 1 - Math.max(MODEL_SHARE, MIN_MODEL_PX / width); // share of the width
  const tallest = (1 - EMPTY.dock) * height - heads;
  const high = Math.min(tallest, (pictures * width) / (scan + photo));
  const share = (/** @type {number} */ aspect) => clamp((aspect * high) / width, MIN_PICTURE, pictures - MIN_PICTURE);
  const [left, middle] = [share(scan), share(photo)];
  return { left, middle, dock: clamp(1 - (high + heads) / height, EMPTY.dock, MAX_DOCK_OF_ITSELF) };
};

/**
 * Compute the shares after moving a divider; every pane keeps a minimum share.
 * @param {Shares} layout
 * @param {Divider} divider between scan and photograph, photograph and model, panes and dock
 * @param {number} to its new position, a share of the width from the left; for the dock, a share of the height
 * @returns {Shares}
 */
const moved = (layout, divider, to) => {
  const { left, middle, dock } = layout;
  if (divider === "dock") return { left, middle, dock: clamp(to, MIN_DOCK, MAX_DOCK) };
  if (divider === "middle") return { left, middle: clamp(to - left, MIN_PANE, 1 - left - MIN_PANE), dock };
  const both = left + middle; // the other divider stays in place
  const found = clamp(to, MIN_PANE, both - MIN_PANE);
  return { left: found, middle: both - found, dock };
};

/** @param {Shares} layout @param {Divider} divider @returns {number} position of a divider, as `moved` takes it */
const positionOf = ({ left, middle, dock }, divider) => ({ left, middle: left + middle, dock })[divider];

/** @param {Divider} name @param {HTMLElement} area @param {() => Shares} layoutNow */
const divider = (name, area, layoutNow) => {
  const level = name === "dock";
  const bar = element("div", {
    class: `divider ${level ? "level" : "upright"}`,
    role: "separator",
    tabIndex: 0,
    title: `${LABELS[name]}: drag, or use the arrow keys; double click resets it`,
    "aria-label": LABELS[name],
    "aria-orientation": level ? "horizontal" : "vertical",
    "aria-valuemin": 0,
    "aria-valuemax": 100,
  });
  const set = (/** @type {number} */ to) => {
    const { left, middle, dock } = moved(layoutNow(), name, to);
    view.set({ layout: level ? { dock } : { left, middle } });
  };
  const shareAt = (/** @type {MouseEvent} */ event) => {
    const box = area.getBoundingClientRect();
    return level ? (box.bottom - event.clientY) / box.height : (event.clientX - box.left) / box.width;
  };
  bar.addEventListener("pointerdown", (event) => {
    if (event.button !== 0) return;
    event.preventDefault();
    bar.focus();
    bar.setPointerCapture(event.pointerId);
    document.body.classList.add("dividing");
  });
  bar.addEventListener("pointermove", (event) => bar.hasPointerCapture(event.pointerId) && set(shareAt(event)));
  bar.addEventListener("lostpointercapture", () => document.body.classList.remove("dividing"));
  bar.addEventListener("dblclick", () => view.set({ layout: level ? { dock: null } : { left: null, middle: null } }));
  bar.addEventListener("keydown", (event) => {
    const direction = DIRECTIONS[event.key];
    const applies = direction && (event.key === "ArrowUp" || event.key === "ArrowDown") === level;
    if (!applies || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    event.stopPropagation();
    set(positionOf(layoutNow(), name) + direction * STEP * (event.shiftKey ? 5 : 1));
  });
  return bar;
};

/**
 * Insert the dividers.
 * @param {HTMLElement} workbench contains panes and dock
 * @param {HTMLElement} panes
 */
export const mountDividers = (workbench, panes) => {
  const [scan, photo] = [...panes.children].filter((pane) => pane instanceof HTMLElement);
  /** @returns {Shares} of those that nobody has moved */
  const suited = () => {
    const found = store.scanBeside()?.views?.[view.get().scan.view] ?? store.scanBeside()?.views?.[0];
    const shown = store.photo();
    const aspects = [found, shown].map((each) => (each?.height ? each.width / each.height : 0)); // 0: there is none
    const known = aspects.find(Boolean);
    const [width, height] = [workbench.clientWidth, workbench.clientHeight];
    const sideBySide = scan.offsetTop === photo.offsetTop && photo.offsetLeft > scan.offsetLeft;
    if (!known || !sideBySide || !height) return EMPTY;
    const heads = Math.max(...[scan, photo].map((pane) => pane.clientHeight - partOf(pane, ".pane-body").clientHeight));
    return sharesFor({ width, height }, heads, aspects.map((each) => each || known));
  };
  /** @returns {Shares} */
  const layoutNow = () => {
    const { left, middle, dock } = view.get().layout;
    const found = suited();
    return { left: left ?? found.left, middle: middle ?? found.middle, dock: dock ?? found.dock };
  };
  /** @type {[Divider, HTMLElement, HTMLElement][]} each with the area that it divides, and what it follows */
  const places = [["left", panes, scan], ["middle", panes, photo], ["dock", workbench, panes]];
  const dividers = places.map(([name, area, before]) => {
    const bar = divider(name, area, layoutNow);
    before.after(bar);
    return { name, bar };
  });
  const show = () => {
    const layout = layoutNow();
    for (const [name, share] of Object.entries(layout)) document.documentElement.style.setProperty(
      `--share-${name}`,
      share.toFixed(5),
    );
    for (const { name, bar } of dividers) bar.setAttribute("aria-valuenow", String(Math.round(100 * positionOf(layout, name))));
  };
  view.on((_, changed) => changed.has("layout") && show());
  store.watch(["scan", "beside", "photos", "shown"], show);
  new ResizeObserver(show).observe(workbench);
  show();
};
