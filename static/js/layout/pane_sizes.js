/** Arithmetic of the dividers. No DOM here. */

const LEAST_PANE = 0.12;
const LEAST_DOCK = 0.08;
const MOST_DOCK = 0.8;

const clamp = (value, least, most) => Math.min(most, Math.max(least, value));

/**
 * Move a divider; no pane becomes narrower than the least share.
 * @param {{left: number, middle: number, dock: number}} layout shares of the window
 * @param {"left" | "middle" | "dock"} divider between scan and photograph, photograph and model, panes and dock
 * @param {number} to where it shall be, as a share from the left; for the dock, its height's share
 * @returns {{left: number, middle: number, dock: number}}
 */
export const moved = (layout, divider, to) => {
  const { left, middle, dock } = layout;
  if (divider === "dock") return { left, middle, dock: clamp(to, LEAST_DOCK, MOST_DOCK) };
  if (divider === "middle") return { left, middle: clamp(to - left, LEAST_PANE, 1 - left - LEAST_PANE), dock };
  const both = left + middle; // the other divider stays where it is
  const found = clamp(to, LEAST_PANE, both - LEAST_PANE);
  return { left: found, middle: both - found, dock };
};

/** @returns {number} where a divider is, as `moved` takes it */
export const placeOf = ({ left, middle, dock }, divider) => ({ left, middle: left + middle, dock })[divider];
