/** Keys of the two image panes: tools, zoom, moving ends, stepping through matches, and drawing without a mouse. */

import { isTyping } from "../ui/dom.js";
import { isWhole } from "./picking.js";
import { axisOf } from "./projection.js";
import { angleBetween } from "./strip_geometry.js";

/** @type {Partial<Record<string, readonly [number, number]>>} */
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
/** @type {Partial<Record<string, import("../state/view.js").ViewState["tool"]>>} */
const TOOLS = { l: "line", p: "point", d: "measure", v: "select", s: "select" };
const NUDGE_PX = 0.1;
const ZOOM_STEP = 1.25;

const USES_KEYS = "[role=grid], [role=listbox], [role=slider], [role=separator], [role=tablist], [role=menu], table, canvas[tabindex], input";
const PRESSABLE = "button, a, summary, label";
const PRESS_KEYS = new Set(["Enter", " ", "Tab"]);

/** Keys that work even where a control uses other keys itself. */
const EVERYWHERE = new Set(["l", "p", "d", "v", "s", "o", "n", "k", "c", "x", "escape"]);

/**
 * What keys do to matches and to the crosshair; most return whether there was anything to do.
 * @param {import("./controller.js").Controller} controller
 */
const actionsOf = (controller) => {
  const { view } = controller;
  const pane = () => controller.panes[controller.active];

  /** @returns {boolean} whether the only selected match, or its selected end, can be seen in the pane with the keys */
  const nudgeable = () => {
    const pick = controller.chosen && controller.pick(controller.chosen);
    if (!pick || !pane().extent) return false;
    const { end } = view.get();
    /** @param {readonly number[]} at */
    const seen = ([x, y]) => x >= 0 && y >= 0 && x <= pane().size[0] && y <= pane().size[1];
    return controller.pendingMoves.endsOf(pick, controller.active).some((world, index) => {
      const uv = (!end || end.index === index) && controller.sides[controller.active].toPixel(world);
      return uv && seen(pane().screenOf(uv));
    });
  };

  /** Move the selected end, or all ends if none is selected, in the pane with the keys. @param {readonly number[]} by */
  const nudge = (by) => {
    const pick = controller.chosen && controller.pick(controller.chosen);
    if (!pick || controller.store.readOnly) return false;
    const { end } = view.get();
    const { active } = controller;
    const side = controller.sides[active];
    const ends = controller.pendingMoves.endsOf(pick, active).map((world, index) => {
      if (end && end.index !== index) return world;
      const uv = side.toPixel(world);
      return uv && side.toWorld([uv[0] + by[0], uv[1] + by[1]]);
    });
    if (isWhole(ends)) {
      controller.nudged = { side: active, id: pick.id, index: end?.index ?? 0 };
      controller.pendingMoves.commit(pick.id, active, ends);
    }
    return true;
  };

  /** Move the crosshair that replaces the pointer. @param {readonly number[]} by */
  const moveCrosshair = (by) => {
    const { active } = controller;
    if (!pane().extent) return false;
    const start = controller.cursor?.side === active ? controller.cursor.uv : pane().pixelAt(pane().size.map((length) => length / 2));
    const uv = pane().pixelAt(pane().screenOf([start[0] + by[0], start[1] + by[1]]));
    controller.moveCursor(active, uv);
    return true;
  };

  /** Accept the predicted partner; if the crosshair was moved since it appeared, set an end there instead. */
  const enter = () => {
    const { picking, measuring } = controller;
    const { cursor } = controller;
    if (controller.tool === "measure") {
      if (cursor?.moved && cursor.side === controller.active) measuring.set(cursor.side, controller.positionAt(cursor.side, cursor.uv));
      else if (measuring.finishable) measuring.finish();
      else return false;
      if (cursor) cursor.moved = false;
      return true;
    }
    if (picking.acceptable && !picking.drawing && !cursor?.moved) return controller.accept();
    const { tool } = controller;
    if (!cursor || cursor.side !== controller.active || tool === "select") return false;
    controller.handle(picking.set(cursor.side, tool, controller.positionAt(cursor.side, cursor.uv)));
    cursor.moved = false;
    if (picking.missingSide && !picking.drawing && picking.missingSide !== controller.active) controller.panes[picking.missingSide].body.focus();
    return true;
  };

  /** @param {number} step */
  const stepMatch = (step) => {
    const picks = controller.store.picksOf();
    const at = picks.findIndex(({ id }) => id === controller.chosen);
    if (picks.length === 0) return false;
    const next = at < 0 ? (step > 0 ? 0 : picks.length - 1) : at + step;
    if (next < 0 || next >= picks.length) {
      controller.select([]);
      return false; // past the last match, Tab moves the focus as usual
    }
    controller.select([picks[next].id], 0);
    view.set({ reveal: picks[next].id });
    return true;
  };

  /** @param {number} step */
  const chooseEnd = (step) => {
    const pick = controller.chosen && controller.pick(controller.chosen);
    if (!pick) return false;
    const count = pick[controller.active].length;
    const at = view.get().end?.index ?? (step > 0 ? -1 : count);
    view.set({ end: { side: controller.active, index: (at + step + count) % count } });
    return true;
  };

  const remove = () => {
    const picks = [...view.get().selected].filter((id) => controller.pick(id));
    if (picks.length === 0 || controller.store.readOnly) return false;
    controller.select([]);
    controller.edit("remove_picks", { picks });
    return true;
  };

  const toggle = () => {
    const picks = [...view.get().selected].map((id) => controller.pick(id)).filter((pick) => pick !== null);
    if (picks.length > 0 && !controller.store.readOnly) controller.edit("switch_picks", { picks: picks.map(({ id }) => id), on: !picks.every(({ on }) => on) });
  };

  /** @param {number} step */
  const changeView = (step) => {
    const views = controller.sides.scan.scan?.views ?? [];
    const labelled = [...views.keys()].filter((index) => views[index].label);
    if (labelled.length < 2) return false;
    const { index } = controller.sides.scan;
    const at = labelled.indexOf(index);
    /** @param {number} other */
    const off = (other) => angleBetween(axisOf(views[other]), axisOf(views[index]));
    const next = at < 0
      ? labelled.reduce((best, other) => (off(other) < off(best) ? other : best))
      : labelled[(at + step + labelled.length) % labelled.length];
    view.set({ scan: { view: next } });
    return true;
  };

  return { nudgeable, nudge, moveCrosshair, enter, stepMatch, chooseEnd, remove, toggle, changeView };
};

/**
 * Listen to the keyboard.
 * @param {import("./controller.js").Controller} controller
 * @param {import("./tools.js").Tools} tools
 * @param {{held: boolean, used: boolean}} space whether the space bar is held, and has panned meanwhile
 */
export const listenToKeys = (controller, tools, space) => {
  const { view } = controller;
  const pane = () => controller.panes[controller.active];
  const { nudgeable, nudge, moveCrosshair, enter, stepMatch, chooseEnd, remove, toggle, changeView } = actionsOf(controller);
  let freed = false; // after Esc, Tab leaves the panes

  /** @param {KeyboardEvent} event @param {readonly [number, number]} towards */
  const arrow = (event, [dx, dy]) => {
    if (!tools.pointer && !inPane(document.activeElement)) return false;
    if (controller.picking.idle && controller.tool !== "measure" && nudgeable()) return nudge([dx, dy].map((step) => step * (event.shiftKey ? 1 : NUDGE_PX)));
    const step = event.shiftKey ? 10 : event.ctrlKey || event.metaKey ? 0.1 : 1;
    return moveCrosshair([dx * step, dy * step]);
  };

  const escape = () => {
    if (tools.abandon() || controller.measuring.abandon() || controller.abandon()) return true;
    freed = true;
    if (view.get().selected.size === 0) return false;
    controller.select([]);
    return true;
  };

  /** @param {number} factor */
  const zoom = (factor) => {
    const { pointer } = tools;
    pane().zoomTo(pane().viewport.zoom * factor, "hand", pointer?.side === controller.active ? pointer.xy : undefined);
    return true;
  };

  /** @type {Partial<Record<string, () => boolean>>} */
  const actions = {
    "+": () => zoom(ZOOM_STEP),
    "=": () => zoom(ZOOM_STEP),
    "-": () => zoom(1 / ZOOM_STEP),
    0: () => (pane().fit("hand"), true),
    1: () => (pane().zoomTo(1, "hand"), true),
    o: () => (view.set({ loupe: !view.get().loupe }), true),
    c: () => (view.set({ corners: view.get().corners === false }), true),
    x: () => (view.set({ marks: view.get().marks === false }), true),
    n: () => (view.set({ snap: !view.get().snap }), true),
    k: () => (controller.posed ? (view.set({ linked: !view.get().linked }), true) : false),
    "[": () => chooseEnd(-1),
    "]": () => chooseEnd(1),
    Delete: remove,
    Backspace: remove,
    PageUp: () => changeView(-1),
    PageDown: () => changeView(1),
    Escape: escape,
    Enter: enter,
  };

  /** @param {EventTarget | null} target */
  const inPane = (target) => Object.values(controller.panes).some(({ body }) => body === target);

  /** @param {KeyboardEvent} event @returns {boolean} whether the key was handled */
  const handle = (event) => {
    const { key } = event;
    const focused = inPane(event.target);
    const command = event.ctrlKey || event.metaKey;
    if (key === "Tab") return focused && !freed && !command && !event.altKey && stepMatch(event.shiftKey ? -1 : 1);
    freed = freed && focused && key === "Shift";
    const towards = ARROWS[key];
    if (towards && !event.altKey) return arrow(event, towards);
    if (command || event.altKey) return false;
    const tool = TOOLS[key.toLowerCase()];
    if (tool) {
      if (tool !== "select") controller.select([]); // arrows then move the crosshair, not a match drawn before
      view.set({ tool });
      return true;
    }
    const action = actions[key.length === 1 ? key.toLowerCase() : key];
    return action ? action() : false;
  };

  document.addEventListener("keydown", (event) => {
    if (event.defaultPrevented || isTyping(event.target)) return;
    if (document.querySelector("dialog:modal, :popover-open")) return;
    if ((event.ctrlKey || event.metaKey) && event.key.toLowerCase() === "a") {
      // wherever the focus is: the browser would select the text of the whole page
      controller.select(controller.store.picksOf().map(({ id }) => id));
      event.preventDefault();
      return;
    }
    // other controls keep the keys that they use themselves
    const target = /** @type {Element} */ (event.target);
    if (target.closest?.(USES_KEYS) && !EVERYWHERE.has(event.key.toLowerCase())) return;
    if (target.closest?.(PRESSABLE) && PRESS_KEYS.has(event.key)) return;
    if (event.key === "Shift") setSuspended(true);
    if (event.key === " ") {
      event.preventDefault();
      if (!event.repeat) Object.assign(space, { held: true, used: false });
      for (const { body } of Object.values(controller.panes)) body.classList.add("pannable");
      return;
    }
    if (handle(event)) event.preventDefault();
  });

  /** @param {boolean} suspended */
  const setSuspended = (suspended) => {
    controller.suspended = suspended;
    tools.settle();
    controller.redraw("live");
  };

  /** @param {boolean} acted */
  const releaseSpace = (acted) => {
    if (space.held && !space.used && acted) toggle();
    space.held = false;
    for (const { body } of Object.values(controller.panes)) body.classList.remove("pannable");
  };
  document.addEventListener("keyup", (event) => {
    if (event.key === " ") releaseSpace(true);
    if (event.key === "Shift") setSuspended(false);
  });
  window.addEventListener("blur", () => {
    releaseSpace(false);
    setSuspended(false);
  });

  for (const { body, side } of Object.values(controller.panes)) {
    body.addEventListener("focus", () => {
      controller.active = side;
      controller.redraw("live");
    });
    body.addEventListener("blur", () => controller.redraw("live"));
  }
};
