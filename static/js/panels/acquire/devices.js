/** The devices of an acquisition: ports, connection, what they are, where the unit stands, and moving it by hand. */

import { ask } from "../../net/connection.js";
import { request } from "../../net/requests.js";
import { store } from "../../net/store.js";
import { changePlan, onPlan, othersDrive, planNow, setPlan } from "../../state/acquisition.js";
import { view } from "../../state/view.js";
import { button, fill } from "../../ui/controls.js";
import { element, setText } from "../../ui/dom.js";
import { makeDial } from "./dial.js";

const STEPS_DEG = [["0.1", "0.1°"], ["1", "1°"], ["5", "5°"], ["20", "20°"]];
const TWIN = "twin:";
const ARROWS = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };

/** @returns {HTMLElement} the panel */
export const mountDevices = () => {
  let ports = [];
  let example = null;
  let asked = false; // the direction of the first movement has been confirmed

  const unitPort = element("select", { class: "select small", "aria-label": "Port of the pan/tilt unit" });
  const scannerPort = element("select", { class: "select small", "aria-label": "Port of the scanner" });
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
  const choose = element(
    "div",
    { class: "acquire-ports" },
    element("label", {}, element("span", {}, "Pan/tilt unit"), unitPort),
    element("label", {}, element("span", {}, "Scanner"), scannerPort),
  );
  const part = element(
    "section",
    { class: "dock-part acquire-devices", "aria-label": "Devices" },
    element(
      "div",
      { class: "part-head" },
      element("h2", {}, "Devices"),
      element("div", { class: "end edits" }, driver, take, refresh, connect, leave),
    ),
    element("div", { class: "part-body edits" }, choose, models, said, stands, direction),
  );

  const load = async () => {
    if (store.readOnly) return;
    try {
      ({ ports, example } = await ask("acquire_ports"));
    } catch {
      return; // not connected: it is asked again when the step is opened
    }
    if (!planNow()) setPlan(example);
    show();
  };

  const options = (part) => {
    const plan = planNow();
    const twin = example?.[part]?.port ?? "";
    const known = [[twin, "simulated"], ...ports.map(({ port, said: what }) => [port, `${port}: ${what}`])];
    const now = plan?.[part]?.port ?? twin;
    return [known.some(([port]) => port === now) || !now ? known : [...known, [now, now]], now];
  };

  const choosePort = (part, port) => {
    const plan = planNow();
    // A real unit speaks 9600 baud as delivered; the simulated one what its plan says.
    const own = part === "unit" ? { baud: port.startsWith(TWIN) ? example.unit.baud : 9600 } : {};
    if (plan) changePlan({ [part]: { ...plan[part], port, ...own } });
  };
  unitPort.addEventListener("change", () => choosePort("unit", unitPort.value));
  scannerPort.addEventListener("change", () => choosePort("scanner", scannerPort.value));

  const begin = () => request("acquire_connect", { plan: planNow() });

  const jog = async ([pan, tilt]) => {
    const now = store.get("acquisition");
    if (now?.state !== "ready" || othersDrive()) return;
    const size = Number(step.value);
    if (!(await request("acquire_jog", { pan_deg: pan * size, tilt_deg: tilt * size }))) return;
    if (asked || planNow()?.unit.port.startsWith(TWIN)) return;
    asked = true;
    setText(question, `Did the unit turn ${pan ? `to the ${pan > 0 ? "left" : "right"}` : tilt > 0 ? "up" : "down"}?`);
    turned = pan ? 0 : 1;
    direction.hidden = false;
  };

  /** The axis turns the other way round: the plan says so, and the unit is connected again with it. */
  const reverse = async () => {
    direction.hidden = true;
    const signs = [...(planNow().unit.signs ?? [1, 1])];
    signs[turned] *= -1;
    changePlan({ unit: { ...planNow().unit, signs } });
    await request("acquire_disconnect");
    await begin();
  };

  const show = () => {
    const now = store.get("acquisition") ?? { state: "off" };
    const off = now.state === "off";
    const connected = Boolean(now.devices);
    for (const [select, name] of [[unitPort, "unit"], [scannerPort, "scanner"]]) {
      const [known, chosen] = options(name);
      fill(select, known, chosen);
      select.disabled = !off;
    }
    connect.hidden = refresh.hidden = !off;
    choose.hidden = connected;
    connect.disabled = !planNow();
    leave.hidden = off;
    leave.disabled = now.state === "connecting";
    take.hidden = !othersDrive();
    setText(driver, now.driver && !off ? (othersDrive() ? `${now.driver.name} drives` : "You drive") : "");
    // What a run has to say stands beside its picture.
    setText(said, now.state === "connecting" ? "Connecting …" : now.run && connected ? "" : now.said ?? "");
    said.classList.toggle("bad", off && Boolean(now.said));
    setText(models, connected ? [now.devices.unit, now.devices.scanner].filter(Boolean).join(" · ") : "");
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
