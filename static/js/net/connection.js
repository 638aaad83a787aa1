/** The websocket `document`: commands up, slices and events down; it reconnects when the connection is lost. */

import { introduction } from "./identity.js";
import { store } from "./store.js";

const FIRST_WAIT_MS = 300;
const LONGEST_WAIT_MS = 5000;
const LOST =
  "The connection was lost before the answer arrived, so it is unknown whether the command was carried out: " +
  "check when the page is connected again, and repeat it if it was not.";
const OFFLINE =
  "Not connected to the workbench, so nothing was changed: wait until the status bar shows connected, then repeat it.";

/** Close code, and HTTP status, when the workbench serves its maximum number of pages. */
const FULL = 1013;
const UNAVAILABLE = 503;
const CROWDED = "The workbench serves its maximum number of pages: close one that is not needed.";

/** @typedef {"connecting" | "connected" | "lost" | "refused" | "full"} ConnectionState */

/** @type {WebSocket | null} */
let socket = null;
let wait_ms = FIRST_WAIT_MS;
let timer = 0;
let nextId = 1;
/** @type {ConnectionState} */
let state = "connecting";
let reason = "";
/** @type {(() => void)[] | null} what happened before the page was assembled, to be done then; null if nothing has to wait */
let early = null;
/** @param {() => void} act */
const whenAssembled = (act) => {
  if (early) early.push(act);
  else act();
};
/** @type {Map<number, {resolve: (answer: any) => void, reject: (error: Error) => void}>} */
const unanswered = new Map();
/** @type {Set<(state: ConnectionState) => void>} */
const listeners = new Set();

/** @param {ConnectionState} now */
const setState = (now) => {
  if (now === state) return;
  state = now;
  for (const listen of [...listeners]) listen(state);
};

/** @returns {ConnectionState} */
export const connectionState = () => state;

/** @returns {string} the reason for the state "full" */
export const fullReason = () => reason;

/**
 * Call `listen(state)` at each change.
 * @param {(state: ConnectionState) => void} listen
 * @returns {() => void} removes the listener
 */
export const onConnection = (listen) => {
  listeners.add(listen);
  return () => listeners.delete(listen);
};

/** @returns {URL} address of the websocket, relative to the page so that any prefix works */
export const socketAddress = (page = location.href) => {
  const address = new URL("document", page);
  address.protocol = address.protocol === "https:" ? "wss:" : "ws:";
  const query = introduction();
  query.set("packed", "gzip");
  address.search = query.toString();
  address.hash = "";
  return address;
};

/** @typedef {import("../protocol.d.ts").Commands} Commands */

/**
 * Send a command (docs/workbench.md, commands).
 * @template {keyof Commands} Name
 * @param {Name} command
 * @param {Commands[Name]} [args]
 * @returns {Promise<any>} the answer; rejects with an Error whose message is one sentence, and whose `field` names the
 *   argument that is wrong, if it is one
 */
export const ask = (command, args) => {
  const current = socket;
  if (state !== "connected" || !current) return Promise.reject(new Error(OFFLINE));
  const id = nextId++;
  return new Promise((resolve, reject) => {
    unanswered.set(id, { resolve, reject });
    current.send(JSON.stringify({ ...args, project: store.get("project")?.id, id, do: command }));
  });
};

/** @param {any} message a reply */
const settle = (message) => {
  const waiting = unanswered.get(message.reply);
  if (!waiting) return;
  unanswered.delete(message.reply);
  if (message.ok) waiting.resolve(message);
  else {
    const error = new Error(message.error ?? "The workbench refused without a reason: try again.");
    waiting.reject(Object.assign(error, { field: message.field ?? "" }));
  }
};

/** @param {string} text */
const receive = (text) => {
  let message;
  try {
    message = JSON.parse(text);
  } catch {
    return; // if it was one of the workbench's, the next version number does not follow, and the page reconnects
  }
  let continues = true;
  try {
    continues = store.take(message);
  } finally {
    if (message.reply !== undefined) settle(message);
  }
  if (!continues) reconnect();
};

/** Reconnect after a gap in the messages: a new connection receives all slices. */
const reconnect = () => {
  const current = socket;
  if (!current) return;
  closed(current, true);
  current.close();
};

/** @param {string} text */
const setFull = (text) => {
  reason = text || CROWDED;
  setState("full");
  wait_ms = LONGEST_WAIT_MS;
};

/** A websocket does not report why it was refused; a request to the page's own address does. */
const findReason = async () => {
  try {
    const { status } = await fetch("./", { method: "HEAD", cache: "no-store" });
    if (state === "connected") return;
    if (status === UNAVAILABLE) setFull("");
    else setState(status === 401 || status === 403 ? "refused" : "lost");
  } catch {
    if (state === "refused") setState("lost");
  }
};

/** @param {WebSocket} from @param {boolean} opened @param {{code?: number, reason?: string}} [event] */
const closed = (from, opened, { code = 0, reason: text = "" } = {}) => {
  if (socket !== from) return;
  socket = null;
  for (const { reject } of unanswered.values()) reject(new Error(LOST));
  unanswered.clear();
  if (code === FULL) setFull(text);
  else if (state !== "refused") setState("lost");
  if (!opened) findReason();
  timer = setTimeout(open, wait_ms);
  wait_ms = Math.min(2 * wait_ms, LONGEST_WAIT_MS);
};

/** @param {ArrayBuffer} data @returns {Promise<string>} the text of a message that came compressed; empty if it is damaged, which ends in a new connection */
const unpacked = (data) =>
  new Response(new Blob([data]).stream().pipeThrough(new DecompressionStream("gzip"))).text().catch(() => "");

/**
 * @param {(text: string) => void} take
 * @returns {(data: string | ArrayBuffer) => void} calls `take(text)` for each message, in the order of the messages
 */
const inOrder = (take) => {
  /** @type {Promise<void> | null} */
  let unpacking = null;
  return (data) => {
    if (typeof data === "string" && !unpacking) {
      take(data);
      return;
    }
    /** @type {Promise<void>} */
    const own = Promise.all([typeof data === "string" ? data : unpacked(data), unpacking]).then(([text]) => {
      if (unpacking === own) unpacking = null;
      take(text);
    });
    unpacking = own;
  };
};

const open = () => {
  clearTimeout(timer);
  const current = new WebSocket(socketAddress());
  let opened = false;
  socket = current;
  current.binaryType = "arraybuffer";
  current.addEventListener("open", () => {
    opened = true;
  });
  const take = inOrder((text) => {
    whenAssembled(() => {
      if (socket !== current) return;
      wait_ms = FIRST_WAIT_MS;
      setState("connected"); // not at "open": a page beyond the maximum is opened, too, and closed at once
      receive(text);
    });
  });
  current.addEventListener("message", ({ data }) => take(data));
  current.addEventListener("close", (event) => whenAssembled(() => closed(current, opened, event)));
};

/** Connect, but let everything that happens wait until `connect` is called: the page is not assembled yet. */
export const connectEarly = () => {
  early = [];
  open();
};

/** Connect, unless that was done early, and reconnect whenever the connection ends. */
export const connect = () => {
  const waiting = early ?? [];
  early = null;
  if (socket === null) open();
  for (const act of waiting) act();
};

/** Try now instead of at the end of the waiting time. */
export const connectNow = () => {
  if (socket === null) open();
};

addEventListener("online", connectNow);
document.addEventListener("visibilitychange", () => document.visibilityState === "visible" && connectNow());
