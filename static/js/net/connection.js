/** The websocket `document`: questions up, slices and events down, and a new connection when it is lost. */

import { store } from "./store.js";

const FIRST_WAIT_MS = 300;
const LONGEST_WAIT_MS = 5000;
const LOST =
  "The connection was lost before the answer came, so it is not known whether this was done: look at " +
  "the page when it is back, and do it again if it was not.";
const OFFLINE =
  "There is no connection to the workbench, so nothing was changed: wait until the status bar says " +
  "connected, and do it again.";

/** The code that a page is turned away with where too many are open, and the status of an answer that says so. */
const FULL = 1013;
const UNAVAILABLE = 503;
const CROWDED = "More pages are open than the workbench serves: close one that nobody needs.";

/** @typedef {"connecting" | "connected" | "lost" | "refused" | "full"} ConnectionState */

let socket = null;
let wait_ms = FIRST_WAIT_MS;
let timer = 0;
let next = 1;
/** @type {ConnectionState} */
let state = "connecting";
let reason = "";
const unanswered = new Map();
const listeners = new Set();

const become = (now) => {
  if (now === state) return;
  state = now;
  for (const listen of [...listeners]) listen(state);
};

/** @returns {ConnectionState} */
export const connectionState = () => state;

/** @returns {string} why there is no place, in the state "full" */
export const fullReason = () => reason;

/**
 * Call `listen(state)` at each change.
 * @param {(state: ConnectionState) => void} listen
 * @returns {() => void} stops it
 */
export const onConnection = (listen) => {
  listeners.add(listen);
  return () => listeners.delete(listen);
};

/** @returns {URL} the websocket's address, in the page's own folder, under any prefix */
export const socketAddress = (page = location.href) => {
  const address = new URL("document", page);
  address.protocol = address.protocol === "https:" ? "wss:" : "ws:";
  address.search = "";
  address.hash = "";
  return address;
};

/**
 * Ask for something by name (docs/workbench.md, commands).
 * @param {string} what
 * @param {Record<string, any>} [args]
 * @returns {Promise<any>} the answer; rejects with an Error whose message is one sentence
 */
export const ask = (what, args = {}) => {
  if (state !== "connected") return Promise.reject(new Error(OFFLINE));
  const id = next++;
  return new Promise((resolve, reject) => {
    unanswered.set(id, { resolve, reject });
    socket.send(JSON.stringify({ ...args, id, do: what }));
  });
};

const answered = (message) => {
  const waiting = unanswered.get(message.reply);
  if (!waiting) return;
  unanswered.delete(message.reply);
  if (message.ok) waiting.resolve(message);
  else waiting.reject(new Error(message.error ?? "The workbench did not say why it refused: try again."));
};

const heard = (text) => {
  let message;
  try {
    message = JSON.parse(text);
  } catch {
    return; // not ours; if it was, the next one does not follow on what is here, and all is told anew
  }
  if (message.reply !== undefined) answered(message);
  else if (!store.take(message)) anew();
};

/** A page that cannot follow is told everything when it comes again. */
const anew = () => {
  const mine = socket;
  ended(mine, true);
  mine.close();
};

const full = (said) => {
  reason = said || CROWDED;
  become("full");
  wait_ms = LONGEST_WAIT_MS;
};

/** A websocket does not tell why it was turned away; the page's own address does. */
const lookWhy = async () => {
  try {
    const { status } = await fetch("./", { method: "HEAD", cache: "no-store" });
    if (state === "connected") return;
    if (status === UNAVAILABLE) full("");
    else become(status === 401 || status === 403 ? "refused" : "lost");
  } catch {
    if (state === "refused") become("lost");
  }
};

const ended = (mine, opened, { code = 0, reason: said = "" } = {}) => {
  if (socket !== mine) return;
  socket = null;
  for (const { reject } of unanswered.values()) reject(new Error(LOST));
  unanswered.clear();
  if (code === FULL) full(said);
  else if (state !== "refused") become("lost");
  if (!opened) lookWhy();
  timer = setTimeout(connect, wait_ms);
  wait_ms = Math.min(2 * wait_ms, LONGEST_WAIT_MS);
};

/** Connect, and again whenever the connection ends. */
export const connect = () => {
  clearTimeout(timer);
  const mine = new WebSocket(socketAddress());
  let opened = false;
  socket = mine;
  mine.addEventListener("open", () => {
    opened = true;
  });
  mine.addEventListener("message", (event) => {
    if (socket !== mine || typeof event.data !== "string") return;
    wait_ms = FIRST_WAIT_MS;
    become("connected"); // not before: a page too many is heard, too, only to be turned away
    heard(event.data);
  });
  mine.addEventListener("close", (event) => ended(mine, opened, event));
};

/** Try at once instead of at the end of the wait. */
export const connectNow = () => {
  if (socket === null) connect();
};

addEventListener("online", connectNow);
document.addEventListener("visibilitychange", () => document.visibilityState === "visible" && connectNow());
