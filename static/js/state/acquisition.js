/** The acquisition as this page sees it: the plan that is being edited, kept over a reload, and who drives. No DOM here. */

import { store } from "../net/store.js";

const KEY = "ladarreg-plan";

/** @typedef {{name: string, label: string, done: boolean, missing: string, status: string}} WorkStep */

let plan = null;
const listeners = new Set();

const stored = () => {
  try {
    return JSON.parse(localStorage.getItem(KEY) ?? "null");
  } catch {
    return null; // storage is disabled, or was written by another version
  }
};

/** @returns {any} the plan that is being edited, as plan.json; null before there is one */
export const planNow = () => (plan ??= store.get("acquisition")?.plan ?? stored());

/** Replace the plan; every listener is called. */
export const setPlan = (next) => {
  plan = next;
  try {
    localStorage.setItem(KEY, JSON.stringify(next));
  } catch {
    // storage is disabled: it has to be made again after a reload
  }
  for (const listen of listeners) listen(plan);
};

/** Change parts of the plan. */
export const changePlan = (patch) => plan && setPlan({ ...plan, ...patch });

export const onPlan = (listen) => listeners.add(listen);

/** @returns {boolean} whether somebody else, who is still connected, drives the devices */
export const othersDrive = () => {
  const driver = store.get("acquisition")?.driver;
  const people = store.get("people");
  if (!driver || driver.id === people?.you) return false;
  return Boolean(people?.clients?.some(({ id }) => id === driver.id));
};

/** @returns {boolean} whether something moves or measures */
export const isActive = () => ["jogging", "running", "paused", "fault"].includes(store.get("acquisition")?.state);

/** @returns {boolean} whether devices are being connected */
export const isConnecting = () => store.get("acquisition")?.state === "connecting";

/** @returns {boolean} whether there is anything that Stop could stop */
export const canBeStopped = () => !["off", undefined].includes(store.get("acquisition")?.state);

const OVERVIEW_STEP_DEG = 6;

/**
 * @returns {any} a coarse plan over all that the unit can turn to and a line scanner sees, by which one chooses what is
 *   scanned; null for a scanner with a field of view of its own
 */
export const overviewPlan = () => {
  const { lowest_deg: low, highest_deg: high } = store.get("acquisition")?.devices ?? {};
  if (!planNow() || planNow().mode !== "sweep" || !low || !high) return null;
  // A line beyond the zenith shows what lies behind: half a turn is a panorama, and more would be seen twice.
  const widest = Math.min(90, -Math.ceil(low[0]), Math.floor(high[0]));
  const end = OVERVIEW_STEP_DEG * Math.floor(widest / OVERVIEW_STEP_DEG);
  return { ...planNow(), pan_deg: [-end, end, OVERVIEW_STEP_DEG], tilt_deg: [0, 0, 0], settle_s: 0, continuous: false, passes: 1, camera: null };
};

/** @returns {WorkStep} the tab's state */
export const acquireStep = () => {
  const now = store.get("acquisition");
  const said = {
    off: "Scan all around with a pan/tilt unit.",
    connecting: "Connecting.",
    ready: "Connected.",
    jogging: "The unit moves.",
    running: `${now?.done} of ${now?.total} pieces.`,
    paused: "Paused.",
    fault: now?.said,
  }[now?.state ?? "off"];
  return { name: "acquire", label: "Acquire", done: Boolean(now?.complete), missing: "", status: said ?? "" };
};
