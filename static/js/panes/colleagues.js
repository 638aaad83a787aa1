/** Other people in the pictures: their pointers with their names, and following somebody's part of the pictures. */

import { throttled } from "../ui/throttle.js";
import { allowed, centredOn, fitted, middle } from "./viewport.js";

/**
 * @typedef {import("./colors.js").Look} Look
 * @typedef {import("./picking.js").Side} Side
 * @typedef {import("../net/store.js").Events} Events
 * @typedef {import("../net/store.js").Person} Person
 * @typedef {import("../net/requests.js").Commands} Commands
 */

const INTERVAL_MS = 100;
const STEADY_MS = 3000;
const FADING_MS = 1500;
const REDRAW_MS = 100;
const ARROW = [[0, 0], [0, 13], [3.6, 9.8], [6, 15], [8.4, 13.9], [6, 8.9], [10.6, 8.6]];

/** The pointers of other people, and the views that are followed. */
export class Colleagues {
  #controller;
  /** @type {Map<string, Omit<Events["cursor"], "event" | "client" | "uv"> & {uv: number[], since: number}>} */
  #cursors = new Map();
  #timer = 0;
  #followers = 0;
  #sendView;

  /**
   * @param {import("./controller.js").Controller} controller
   * @param {import("./tools.js").Tools} tools
   */
  constructor(controller, tools) {
    this.#controller = controller;
    const { store } = controller;
    /** @param {Commands["point"]} pointer */
    const send = (pointer) => controller.ask("point", pointer);
    const sendCursor = throttled(send, INTERVAL_MS);
    /** @param {Side} side @param {number[] | null} uv */
    const point = (side, uv) => store.colleagues().length > 0 && sendCursor({ ...this.#place(side), uv });
    tools.onPointer((pane, uv) => point(pane.side, uv));
    tools.onLeave((pane) => point(pane.side, null));
    this.#sendView = {
      scan: throttled(() => this.#showView("scan"), INTERVAL_MS),
      photo: throttled(() => this.#showView("photo"), INTERVAL_MS),
    };
    store.onEvent("cursor", (event) => this.#receive(event));
    store.onEvent("view", (event) => this.#follow(event));
    store.watch(["people"], () => this.#peopleChanged());
  }

  /** Listen to the movements of the pictures; the panes exist by now. */
  watchPanes() {
    for (const pane of Object.values(this.#controller.panes)) {
      pane.onMove((moved, by) => {
        if (by === "hand" && this.leader) this.#leave();
        if (this.#followers > 0 && moved.extent) this.#sendView[moved.side]();
      });
    }
  }

  /** @returns {Person | null} the person whose view is followed, or null */
  get leader() {
    const { store } = this.#controller;
    return store.colleagues().find(({ id }) => id === store.me()?.follows) ?? null;
  }

  /** @param {Side} side */
  #place(side) {
    const { store, sides } = this.#controller;
    return { side, photo: store.shown(), view: side === "scan" ? sides.scan.index : 0 };
  }

  /** @param {Side} side */
  #showView(side) {
    const pane = this.#controller.panes[side];
    if (!pane.extent || pane.size[0] === 0) return null;
    const centre = middle(pane.viewport, pane.size);
    return this.#controller.ask("show_view", { ...this.#place(side), centre, zoom: pane.relativeZoom });
  }

  /** Nothing moves under the hands: whoever moves a picture stops following. */
  #leave() {
    const name = this.leader?.name;
    this.#controller.ask("follow", { client: null }).catch(() => {});
    this.#controller.store.take({ event: "notice", level: "info", text: `You no longer follow ${name}.` });
  }

  /** @param {Events["view"]} event */
  #follow({ client, side, view, photo, station, centre, zoom }) {
    const { store, sides, panes } = this.#controller;
    const pane = panes[side];
    if (client !== this.leader?.id || !pane?.extent || pane.size[0] === 0 || !centre) return;
    if (side === "photo" ? photo !== store.shown() : station !== store.station()) return;
    if (side === "scan" && view !== sides.scan.index) this.#controller.view.set({ scan: { view } });
    const scale = allowed(fitted(pane.size, pane.extent).zoom * zoom, pane.size, pane.extent);
    pane.place(centredOn(centre, scale, pane.size), "link");
  }

  #peopleChanged() {
    const { store } = this.#controller;
    const me = store.me()?.id;
    const colleagues = store.colleagues();
    const followers = colleagues.filter(({ follows }) => follows === me).length;
    if (followers > this.#followers) for (const send of Object.values(this.#sendView)) send();
    this.#followers = followers;
    const there = new Set(colleagues.map(({ id }) => id));
    for (const id of [...this.#cursors.keys()]) if (!there.has(id)) this.#cursors.delete(id);
    this.#controller.redraw("live");
  }

  /** @param {Events["cursor"]} event */
  #receive({ client, side, view, photo, station, uv }) {
    if (uv) this.#cursors.set(client, { side, view, photo, station, uv, since: performance.now() });
    else this.#cursors.delete(client);
    this.#controller.redraw("live");
  }

  /**
   * Draw the pointers of those who see the same picture; they fade while they rest.
   * @param {CanvasRenderingContext2D} context
   * @param {import("./pane.js").Pane} pane
   * @param {Look} look
   */
  paint(context, pane, look) {
    if (this.#cursors.size === 0) return;
    const here = this.#place(pane.side);
    const now = performance.now();
    let fading = false;
    for (const { id, name, colour } of this.#controller.store.colleagues()) {
      const cursor = this.#cursors.get(id);
      if (!cursor || cursor.side !== pane.side || cursor.view !== here.view) continue;
      if (pane.side === "photo" ? cursor.photo !== here.photo : cursor.station !== this.#controller.store.station()) continue;
      const rest = now - cursor.since;
      const strength = Math.min(1, 1 - (rest - STEADY_MS) / FADING_MS);
      if (strength <= 0) {
        this.#cursors.delete(id);
        continue;
      }
      fading = true;
      drawPointer(context, pane.screenOf(cursor.uv), { name, colour: look.people[colour - 1], strength }, look);
    }
    if (fading && !this.#timer) {
      this.#timer = setTimeout(() => {
        this.#timer = 0;
        this.#controller.redraw("live");
      }, REDRAW_MS);
    }
  }
}

/**
 * @param {CanvasRenderingContext2D} context
 * @param {readonly number[]} at
 * @param {{name: string, colour: string, strength: number}} person
 * @param {Look} look
 */
const drawPointer = (context, [x, y], { name, colour, strength }, look) => {
  const { scale } = look;
  context.save();
  context.globalAlpha = strength;
  context.translate(x, y);
  context.beginPath();
  for (const [dx, dy] of ARROW) context.lineTo(dx * scale, dy * scale);
  context.closePath();
  context.lineJoin = "round";
  context.lineWidth = 3 * scale;
  context.strokeStyle = look.halo;
  context.stroke();
  context.fillStyle = colour;
  context.fill();
  context.font = look.font;
  context.textBaseline = "top";
  const [left, top] = [12 * scale, 13 * scale];
  context.lineWidth = 4 * scale;
  context.strokeText(name, left, top);
  context.fillText(name, left, top);
  context.restore();
};
