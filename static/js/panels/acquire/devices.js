/** The devices of an acquisition: ports, connection, what they are, where the unit stands, and moving it by hand. */

import { ask } from "../../net/connection.js";
import { request } from "../../net/requests.js";
import { store } from "../../net/store.js";
import { acquisitionNow, changePlan, offerPlan, onPlan, othersDrive, planNow } from "../../state/acquisition.js";
import { view } from "../../state/view.js";
import { button, fill } from "../../ui/controls.js";
import { element, setText } from "../../ui/dom.js";
import { makeDeviceChoice } from "./device_choice.js";
import { makeDial } from "./dial.js";

/** @type {[string, string][]} */
const STEPS_DEG = [["0.1", "0.1°"], ["1", "1°"], ["5", "5°"], ["20", "20°"]];
/** @type {Record<string, string>} what a state says while it lasts */
const PASSING = { connecting: "Connecting …", disconnecting: "Disconnecting …" };
const TWIN = "twin:";
/** @type {Record<string, number[]>} */
const ARROWS = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };

/** @returns {HTMLElement} the panel */
export const mountDevices = () => {
  /** @type {import("./device_choice.js").Port[]} */
  let ports = [];
  /** @type {import("../../protocol.d.ts").PlanFields | null} */
  let example = null;
  const confirmed = [false, false]; // whether somebody was asked which way pan and tilt turn

  const choice = makeDeviceChoice();
  const refresh = button({ label: "Look for ports again", icon: "redo", kind: "plain small", bare: true, act: () => load() });
  const connect = button({ label: "Connect", kind: "primary small", act: () => begin() });
  const leave = button({ label: "Disconnect", kind: "small", act: () => request("acquire_disconnect") });
  const take = button({ label: "Take over", kind: "small", act: () => request("acquire_take_over") });
  const driver = element("span", { class: "dim" });
  const said = element("p", { class: "acquire-said", role: "status" });
  const models = element("p", { class: "dim acquire-models" });
  const dial = makeDial();
  const step = element("select", { class: "select small", "aria-label": "Step of a movement by hand" });
  fill(step, STEPS_DEG, "5");
  const jogs = element(
    "div",
    { class: "jogs", role: "group", "aria-label": "Move the unit" },
    ...[["ArrowUp", "↑", "Up"], ["ArrowLeft", "←", "Left"], ["ArrowRight", "→", "Right"], ["ArrowDown", "↓", "Down"]].map(
      ([key, text, label]) => button({ label, text, kind: `small jog ${label.toLowerCase()}`, act: () => jog(ARROWS[key]) }),
    ),
    step,
  );
  jogs.addEventListener("keydown", (event) => {
    if (!ARROWS[event.key] || event.target === step) return;
    event.preventDefault();
    event.stopPropagation();
    jog(ARROWS[event.key]);
  });
  let turned = 0;
  const question = element("span", {});
  const direction = element(
    "div",
    { class: "row", role: "group", "aria-label": "Direction of the unit", hidden: true },
    question,
    button({ label: "Yes", kind: "small", act: () => (direction.hidden = true) }),
    button({ label: "No, the other way", kind: "small", act: () => reverse() }),
  );
  const stands = element("div", { class: "acquire-stands", hidden: true }, dial.element, jogs);
  const part = element(
    "section",
    { class: "dock-part acquire-devices", "aria-label": "Devices" },
    element(
      "div",
      { class: "part-head" },
      element("h2", {}, "Devices"),
      element("div", { class: "end edits" }, driver, take, refresh, connect, leave),
    ),
    element("div", { class: "part-body edits" }, choice.element, models, said, stands, direction),
  );

  const load = async () => {
    if (store.readOnly) return;
    try {
      let draft;
      ({ ports, example, draft } = await ask("acquire_ports"));
      offerPlan(draft ?? example);
    } catch {
      return; // not connected: it is asked again when the step is opened
    }
    show();
  };

  const begin = async () => {
    const plan = planNow();
    if (plan) await request("acquire_connect", { plan });
  };

  const jog = async (/** @type {number[]} */ [pan, tilt]) => {
    if (acquisitionNow().state !== "ready" || othersDrive()) return;
    const size = Number(step.value);
    if (!(await request("acquire_jog", { pan_deg: pan * size, tilt_deg: tilt * size }))) return;
    turned = pan ? 0 : 1;
    if (confirmed[turned] || planNow()?.unit?.port?.startsWith(TWIN)) return;
    confirmed[turned] = true;
    setText(question, `Did the unit turn ${pan ? `to the ${pan > 0 ? "left" : "right"}` : tilt > 0 ? "up" : "down"}?`);
    direction.hidden = false;
  };

  /** The axis turns the other way round: the plan says so, and the unit is connected again with it. */
  const reverse = async () => {
    direction.hidden = true;
    const unit = planNow()?.unit;
    const signs = [...(unit?.signs ?? [1, 1])];
    signs[turned] *= -1;
    changePlan({ unit: { ...unit, signs } });
    await request("acquire_disconnect");
    await begin();
  };

  const show = () => {
    const now = acquisitionNow();
    const off = now.state === "off";
    const { devices } = now;
    const connected = Boolean(devices);
    choice.show(planNow(), ports, example, !off);
    connect.hidden = refresh.hidden = !off;
    choice.element.hidden = connected;
    connect.disabled = !planNow();
    leave.hidden = off;
    leave.disabled = now.state === "connecting" || now.state === "disconnecting";
    take.hidden = !othersDrive();
    setText(driver, now.driver && !off ? (othersDrive() ? `${now.driver.name} drives` : "You drive") : "");
    // What a run has to say stands beside its picture.
    const passing = PASSING[now.state];
    setText(said, passing ?? (now.run && connected ? "" : now.said));
    said.classList.toggle("bad", off && Boolean(now.said));
    setText(models, devices ? [devices.unit, devices.scanner].filter(Boolean).join(" · ") : "");
    stands.hidden = !connected;
    dial.show(now);
    for (const each of jogs.querySelectorAll("button")) each.disabled = now.state !== "ready" || othersDrive();
  };
  store.watch(["acquisition", "people"], show);
  onPlan(show);
  view.on((_, changed) => changed.has("step") && view.get().step === "acquire" && load());
  if (view.get().step === "acquire") store.on("people", () => !example && load());
  show();
  return part;
};
