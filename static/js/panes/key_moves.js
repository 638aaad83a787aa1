/** What keys do to matches and to the crosshair; each tells whether there was something to do. */

/** @param {import("./controller.js").Desk} desk */
export const movesOf = (desk) => {
  const { view } = desk;
  const pane = () => desk.panes[desk.active];

  /** Move the selected end, or both where none is. */
  const nudge = (by) => {
    const pick = desk.chosen && desk.pick(desk.chosen);
    if (!pick) return false;
    const end = view.get().end;
    const side = desk.sides[end?.side ?? desk.active];
    const ends = desk.edits.endsOf(pick, side.name).map((world, index) => {
      if (end && end.index !== index) return world;
      const uv = side.toPixel(world);
      return uv && side.toWorld([uv[0] + by[0], uv[1] + by[1]]);
    });
    if (ends.every(Boolean)) {
      desk.nudged = { side: side.name, id: pick.id, index: end?.index ?? 0 };
      desk.edits.commit(pick.id, side.name, ends);
    }
    return true;
  };

  /** Move the crosshair that stands for the pointer. */
  const walk = (by) => {
    const { active } = desk;
    if (!pane().extent) return false;
    const start = desk.cursor?.side === active ? desk.cursor.uv : pane().pixelAt(pane().size.map((length) => length / 2));
    const uv = pane().pixelAt(pane().screenOf([start[0] + by[0], start[1] + by[1]]));
    desk.moveCursor(active, uv);
    return true;
  };

  /** Enter takes the offer, unless the crosshair has been moved since: then it sets an end. */
  const enter = () => {
    const { picking } = desk;
    const { cursor } = desk;
    if (picking.acceptable && !picking.drawing && !cursor?.moved) return desk.accept();
    const { tool } = view.get();
    if (!cursor || cursor.side !== desk.active || tool === "select") return false;
    desk.took(picking.set(cursor.side, tool, desk.placeAt(cursor.side, cursor.uv)));
    cursor.moved = false;
    if (picking.wanted && !picking.drawing && picking.wanted !== desk.active) desk.panes[picking.wanted].body.focus();
    return true;
  };

  const walkMatches = (step) => {
    const picks = desk.store.picksOf();
    const at = picks.findIndex(({ id }) => id === desk.chosen);
    if (picks.length === 0) return false;
    const next = at < 0 ? (step > 0 ? 0 : picks.length - 1) : at + step;
    if (next < 0 || next >= picks.length) {
      desk.select([]);
      return false; // beyond the last, the focus goes on as anywhere
    }
    desk.select([picks[next].id], 0);
    view.set({ reveal: picks[next].id });
    return true;
  };

  const chooseEnd = (step) => {
    const pick = desk.chosen && desk.pick(desk.chosen);
    if (!pick) return false;
    const count = pick[desk.active].length;
    const at = view.get().end?.index ?? (step > 0 ? -1 : count);
    view.set({ end: { side: desk.active, index: (at + step + count) % count } });
    return true;
  };

  const edit = async (what, args) => {
    try {
      await desk.ask(what, { photo: desk.store.shown(), ...args });
    } catch (error) {
      desk.say(error);
    }
  };

  const remove = () => {
    const picks = [...view.get().selected].filter((id) => desk.pick(id));
    if (picks.length === 0) return false;
    desk.select([]);
    edit("remove_picks", { picks });
    return true;
  };

  const toggle = () => {
    const picks = [...view.get().selected].map((id) => desk.pick(id)).filter(Boolean);
    if (picks.length > 0) edit("switch_picks", { picks: picks.map(({ id }) => id), on: !picks.every(({ on }) => on) });
  };

  const turnPage = (step) => {
    const views = desk.sides.scan.scan?.views ?? [];
    if (views.length < 2) return false;
    view.set({ scan: { view: (desk.sides.scan.index + step + views.length) % views.length } });
    return true;
  };

  return { nudge, walk, enter, walkMatches, chooseEnd, remove, toggle, turnPage };
};
