/** Keys of the two panes: tools, zoom, moving ends, walking through matches, and drawing without a mouse. */

import { isTyping } from "../ui/dom.js";
import { movesOf } from "./key_moves.js";

const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
const TOOLS = { l: "line", p: "point", v: "select", s: "select" };
const NUDGE_PX = 0.1;
const ZOOM_STEP = 1.25;

const MOVED_IN = "[role=grid], [role=listbox], [role=slider], [role=separator], [role=tablist], [role=menu], table, canvas[tabindex], input";
const PRESSED = "button, a, summary, label";
const PRESSES = new Set(["Enter", " ", "Tab"]);

const EVERYWHERE = new Set(["l", "p", "v", "s", "o", "n", "k", "c", "escape"]);

/** @param {import("./controller.js").Desk} desk @param {import("./tools.js").Strokes} strokes @param {{held: boolean, used: boolean}} space */
export const listenToKeys = (desk, strokes, space) => {
  const { view } = desk;
  const pane = () => desk.panes[desk.active];
  const { nudge, walk, enter, walkMatches, chooseEnd, remove, toggle, turnPage } = movesOf(desk);
  let freed = false; // after Esc, Tab leaves the pictures

  const arrow = (event) => {
    const [dx, dy] = ARROWS[event.key];
    const drawn = desk.picking.idle && view.get().selected.size > 0;
    if (drawn) return nudge([dx, dy].map((step) => step * (event.shiftKey ? 1 : NUDGE_PX)));
    const step = event.shiftKey ? 10 : event.ctrlKey || event.metaKey ? 0.1 : 1;
    return walk([dx * step, dy * step]);
  };

  const escape = () => {
    if (strokes.abandon() || desk.abandon()) return true;
    freed = true;
    if (view.get().selected.size === 0) return false;
    desk.select([]);
    return true;
  };

  const zoom = (factor) => {
    const { pointer } = strokes;
    pane().zoomTo(pane().viewport.zoom * factor, "hand", pointer?.side === desk.active ? pointer.xy : undefined);
    return true;
  };

  const actions = {
    "+": () => zoom(ZOOM_STEP),
    "=": () => zoom(ZOOM_STEP),
    "-": () => zoom(1 / ZOOM_STEP),
    0: () => (pane().fit("hand"), true),
    1: () => (pane().zoomTo(1, "hand"), true),
    o: () => (view.set({ loupe: !view.get().loupe }), true),
    c: () => (view.set({ corners: view.get().corners === false }), true),
    n: () => (view.set({ snap: !view.get().snap }), true),
    k: () => (desk.posed ? (view.set({ linked: !view.get().linked }), true) : false),
    "[": () => chooseEnd(-1),
    "]": () => chooseEnd(1),
    Delete: remove,
    Backspace: remove,
    PageUp: () => turnPage(-1),
    PageDown: () => turnPage(1),
    Escape: escape,
    Enter: enter,
  };

  const inPane = (target) => Object.values(desk.panes).some(({ body }) => body === target);

  /** @returns {boolean} whether the key was ours */
  const handle = (event) => {
    const { key } = event;
    const focused = inPane(event.target);
    const command = event.ctrlKey || event.metaKey;
    if (key === "Tab") return focused && !freed && !command && !event.altKey && walkMatches(event.shiftKey ? -1 : 1);
    freed = freed && focused && key === "Shift";
    if (ARROWS[key] && !event.altKey) return arrow(event);
    if (command && key.toLowerCase() === "a") {
      desk.select(desk.store.picksOf().map(({ id }) => id));
      return true;
    }
    if (command || event.altKey) return false;
    const tool = TOOLS[key.toLowerCase()];
    if (tool) {
      view.set({ tool });
      return true;
    }
    const action = actions[key.length === 1 ? key.toLowerCase() : key];
    return action ? action() : false;
  };

  document.addEventListener("keydown", (event) => {
    if (event.defaultPrevented || isTyping(event.target)) return;
    if (document.querySelector("dialog:modal, :popover-open")) return;
    // Other controls keep the keys that they use themselves.
    if (event.target.closest?.(MOVED_IN) && !EVERYWHERE.has(event.key.toLowerCase())) return;
    if (event.target.closest?.(PRESSED) && PRESSES.has(event.key)) return;
    if (event.key === "Alt") setInverted(true);
    if (event.key === " ") {
      event.preventDefault();
      if (!event.repeat) Object.assign(space, { held: true, used: false });
      for (const { body } of Object.values(desk.panes)) body.classList.add("pannable");
      return;
    }
    if (handle(event)) event.preventDefault();
  });

  const setInverted = (inverted) => {
    desk.inverted = inverted;
    desk.redraw("live");
  };

  const release = (acted) => {
    if (space.held && !space.used && acted) toggle();
    space.held = false;
    for (const { body } of Object.values(desk.panes)) body.classList.remove("pannable");
  };
  document.addEventListener("keyup", (event) => {
    if (event.key === " ") release(true);
    if (event.key === "Alt") setInverted(false);
  });
  window.addEventListener("blur", () => {
    release(false);
    setInverted(false);
  });

  for (const { body, side } of Object.values(desk.panes)) {
    body.addEventListener("focus", () => {
      desk.active = side;
      desk.redraw("live");
    });
    body.addEventListener("blur", () => desk.redraw("live"));
  }
};
