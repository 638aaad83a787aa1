/** The acquisition as this page sees it: the plan that is being edited, which the project keeps, and who drives. No DOM here. */

import { ask } from "../net/connection.js";
import { store } from "../net/store.js";
import { throttled } from "../ui/throttle.js";

const KEPT_EVERY_MS = 500;

/**
 * @typedef {import("../protocol.d.ts").PlanFields} PlanFields
 * @typedef {(number | null)[]} Entered numbers, null where none is entered
 * @typedef {{
 *   unit?: Partial<PlanFields["unit"]>,
 *   scanner?: Omit<Partial<PlanFields["scanner"]>, "fov_deg"> & {fov_deg?: Entered},
 *   camera?: Partial<NonNullable<PlanFields["camera"]>> | null, mode?: PlanFields["mode"], pan_deg?: Entered, tilt_deg?: Entered,
 *   settle_s?: number | null, continuous?: boolean, passes?: number,
 *   mount?: Omit<Partial<PlanFields["mount"]>, "xyz_m" | "rpy_deg"> & {xyz_m?: Entered, rpy_deg?: Entered},
 * }} Plan a plan.json that is being edited, right or not
 * @typedef {import("../protocol.d.ts").Acquisition} Acquisition
 * @typedef {{field: string, said: string}} PlanFault
 */

/** @type {Acquisition} before the slice has arrived */
const OFF = {
  state: "off", offered: false, said: "", driver: null, devices: null, plan: null, at_deg: null, done: 0, total: 0,
  seconds_left: 0, complete: false, run: "", picture: null, points: 0, runs: [],
};

/** @returns {Acquisition} the slice `acquisition` */
export const acquisitionNow = () => store.get("acquisition") ?? OFF;

/** @type {Plan | null} */
let plan = null;
/** @type {Set<(plan: Plan) => void>} */
const listeners = new Set();
/** @type {Set<(faults: PlanFault[]) => void>} */
const faultListeners = new Set();

/** @returns {Plan | null} the plan that is being edited; null before there is one */
export const planNow = () => (plan ??= acquisitionNow().plan);

const keep = throttled(async () => {
  if (plan) await ask("acquire_keep", { plan });
}, KEPT_EVERY_MS);

/** @param {Plan} next */
const show = (next) => {
  plan = next;
  for (const listen of listeners) listen(next);
};

/** Replace the plan; every listener is called, and the project keeps it. @param {Plan} next */
export const setPlan = (next) => {
  show(next);
  keep();
};

/** Begin with a plan, if none is being edited. @param {Plan} begun */
export const offerPlan = (begun) => planNow() || show(begun);

/** Change parts of the plan. @param {Plan} patch */
export const changePlan = (patch) => plan && setPlan({ ...plan, ...patch });

/** @param {(plan: Plan) => void} listen called with each change of it */
export const onPlan = (listen) => listeners.add(listen);

/** Tell what is wrong with the plan. @param {PlanFault[]} faults */
export const setFaults = (faults) => {
  for (const listen of faultListeners) listen(faults);
};

/** @param {(faults: PlanFault[]) => void} listen */
export const onFaults = (listen) => faultListeners.add(listen);

/** @returns {boolean} whether another person, who is still connected, drives the devices */
export const othersDrive = () => {
  const { driver } = acquisitionNow();
  const people = store.get("people");
  if (!driver || driver.id === people?.you) return false;
  return store.colleagues().some(({ id }) => id === driver.id);
};

/** @returns {boolean} whether something moves or measures */
export const isActive = () => ["jogging", "running", "paused", "fault"].includes(acquisitionNow().state);

/** @returns {boolean} whether devices are being connected */
export const isConnecting = () => acquisitionNow().state === "connecting";

/** @returns {boolean} whether there is anything that Stop could stop */
export const canBeStopped = () => acquisitionNow().state !== "off";

const OVERVIEW_STEP_DEG = 6;

/**
 * @returns {Plan | null} a coarse plan over all that the unit can turn to and a line scanner sees, by which one chooses what is
 *   scanned; null for a scanner with a field of view of its own
 */
export const overviewPlan = () => {
  const { lowest_deg: low, highest_deg: high } = acquisitionNow().devices ?? {};
  const edited = planNow();
  if (edited?.mode !== "sweep" || !low || !high) return null;
  // A line beyond the zenith shows what lies behind: half a turn is a panorama, and more would be seen twice.
  const widest = Math.min(90, -Math.ceil(low[0]), Math.floor(high[0]));
  const end = OVERVIEW_STEP_DEG * Math.floor(widest / OVERVIEW_STEP_DEG);
  return { ...edited, pan_deg: [-end, end, OVERVIEW_STEP_DEG], tilt_deg: [0, 0, 0], settle_s: 0, continuous: false, passes: 1, camera: null };
};

/** @returns {import("./progress.js").WorkStep} the tab's state */
export const acquireStep = () => {
  const now = acquisitionNow();
  /** @type {Record<Acquisition["state"], string>} */
  const said = {
    off: "Scan all around with a pan/tilt unit.",
    connecting: "Connecting.",
    disconnecting: "Disconnecting.",
    ready: now.devices?.simulated ? "Connected to simulated devices." : "Connected.",
    jogging: "The unit moves.",
    running: `${now.done} of ${now.total} pieces${now.devices?.simulated ? ", simulated" : ""}.`,
    paused: "Paused.",
    fault: now.said,
  };
  return { name: "acquire", label: "Acquire", done: now.complete, missing: "", status: said[now.state] };
};
