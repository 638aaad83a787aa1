/** Which devices a plan drives: the unit's port, the scanner's port or folder, and the camera. */

import { changePlan, planNow } from "../../state/acquisition.js";
import { fill } from "../../ui/controls.js";
import { element } from "../../ui/dom.js";
import { numbersRow, textRow, withFaults } from "./plan_rows.js";

/** @typedef {import("../../state/acquisition.js").Plan} Plan @typedef {import("../../protocol.d.ts").PlanFields} PlanFields @typedef {{port: string, said: string}} Port @typedef {[string, string]} Option */

const TWIN = "twin:";
const TWIN_SCANNER = "twin:scanner";
const TWIN_CAMERA = "twin:camera";
const FOLDER = "folder";
const PACKETS = "packets";
const TWIN_LIDAR = "twin:velodyne";
const VELODYNE_PORT = 2368; // as delivered
const VIDEO_DEVICES = 4;
const UNIT_BAUD = 9600; // as a real unit is delivered
/** @type {Plan} what a plan for a scanner with a field of view of its own begins with: its pieces overlap at 55 degrees across */
const PIECES = {
  mode: "mosaic",
  pan_deg: [-90, 90, 45],
  tilt_deg: [0, 0, 0],
  settle_s: 0.3,
  continuous: false,
  passes: 1,
  mount: { xyz_m: [0.05, 0, 0.1], rpy_deg: [0, 0, 0] },
};

/**
 * @param {string} twin
 * @param {Plan | null} plan
 * @returns {string} the address of a simulated device in the same room as the simulated unit
 */
const beside = (twin, plan) => {
  const [, query = "seed=1"] = (plan?.unit?.port?.startsWith(TWIN) ? plan.unit.port : "").split("?");
  return `${twin}?${query}`;
};

/** @returns {{element: HTMLElement, show: (plan: Plan | null, ports: Port[], example: PlanFields | null, fixed: boolean) => void}} */
export const makeDeviceChoice = () => {
  const select = (/** @type {string} */ label) => element("select", { class: "select small", "aria-label": label });
  const unit = select("Port of the pan/tilt unit");
  const scanner = select("Scanner");
  const camera = select("Camera");
  /** @type {PlanFields | null} */
  let example = null;
  /** @type {Plan | null} of a plan whose scanner was exchanged: what it said before, for when it is exchanged back */
  let other = null;

  /** @template {"unit" | "scanner" | "camera"} Part @param {Part} part @param {NonNullable<Plan[Part]>} patch */
  const change = (part, patch) => changePlan(/** @type {Plan} */ ({ [part]: { ...planNow()?.[part], ...patch } }));
  /** @param {string} label @param {HTMLElement} control @param {string[]} fields */
  const withRow = (label, control, fields) =>
    withFaults(element("label", { class: "plan-choice" }, element("span", {}, label), control), fields);

  const folder = textRow({
    label: "Its folder", hint: "the folder that its software writes to", fields: ["scanner.folder"],
    read: (plan) => plan?.scanner?.folder,
    write: (path) => change("scanner", { folder: path }),
  });
  const port = numbersRow({
    label: "It sends to", unit: "", names: ["UDP port"], fields: ["scanner.udp_port"],
    read: (plan) => [plan?.scanner?.udp_port],
    write: ([value]) => change("scanner", { udp_port: value ?? undefined }),
  });
  const host = textRow({
    label: "Its address", hint: "if several lidars send there", fields: ["scanner.host"],
    read: (plan) => plan?.scanner?.host,
    write: (address) => change("scanner", { host: address || undefined }),
  });
  const sensor = textRow({
    label: "Its JSON", hint: "metadata of an Ouster", fields: ["scanner.sensor_file"],
    read: (plan) => plan?.scanner?.sensor_file,
    write: (path) => change("scanner", { sensor_file: path || undefined }),
  });
  const fov = numbersRow({
    label: "It sees", unit: "°, if you know it", names: ["across", "down"], fields: ["scanner.fov_deg"],
    read: (plan) => plan?.scanner?.fov_deg,
    write: (values) => change("scanner", { fov_deg: values.every((each) => each === null) ? undefined : values }),
  });
  const pictures = textRow({
    label: "Its folder", hint: "the folder that its photographs come to", fields: ["camera.folder"],
    read: (plan) => plan?.camera?.folder,
    write: (path) => change("camera", { folder: path }),
  });

  unit.addEventListener("change", () => {
    const port = unit.value;
    change("unit", { port, baud: (port.startsWith(TWIN) && example?.unit.baud) || UNIT_BAUD });
  });

  /**
   * @param {string} chosen
   * @param {Plan} plan
   * @returns {Plan["scanner"] | null} the device of a choice that makes pieces; null for a line scanner
   */
  const pieceScanner = (chosen, plan) => {
    if (chosen === FOLDER) return { kind: "folder", folder: "" };
    if (chosen === TWIN_SCANNER) return { kind: "folder", folder: beside(TWIN_SCANNER, plan) };
    if (chosen === PACKETS) return { kind: "packets", udp_port: VELODYNE_PORT };
    if (chosen === TWIN_LIDAR) return { kind: "packets", host: beside(TWIN_LIDAR, plan) };
    return null;
  };

  /** Exchange the scanner: a line scanner sweeps, others make pieces, and each begins with a fitting plan. */
  scanner.addEventListener("change", () => {
    const plan = planNow();
    if (!plan) return;
    const pieces = pieceScanner(scanner.value, plan) ?? null;
    if ((pieces !== null) === (plan.mode === "mosaic")) {
      if (pieces?.kind === plan.scanner?.kind || !pieces) change("scanner", pieces ?? { port: scanner.value });
      else changePlan({ scanner: pieces });
      return;
    }
    const before = other?.mode === (pieces ? "mosaic" : "sweep") ? other : pieces ? PIECES : example;
    if (!before) return;
    other = plan;
    const device = pieces ?? { ...example?.scanner, port: scanner.value };
    const { mode, pan_deg, tilt_deg, settle_s, continuous, passes, mount } = before;
    changePlan({ scanner: device, mode, pan_deg, tilt_deg, settle_s, continuous, passes, mount });
  });

  camera.addEventListener("change", () => {
    const chosen = camera.value;
    const mount = planNow()?.camera?.mount ?? null;
    if (chosen === "") changePlan({ camera: null });
    else if (chosen === FOLDER) changePlan({ camera: { folder: "", mount } });
    else if (chosen === TWIN_CAMERA) changePlan({ camera: { folder: beside(TWIN_CAMERA, planNow()), mount: null } });
    else changePlan({ camera: { device: Number(chosen), mount } });
  });

  const body = element(
    "div",
    { class: "acquire-ports" },
    withRow("Pan/tilt unit", unit, ["unit"]),
    withRow("Scanner", scanner, ["scanner.kind", "scanner.port", "scanner.baud", "scanner.lines", "scanner.timeout_s"]),
    folder.row,
    port.row,
    host.row,
    sensor.row,
    fov.row,
    withRow("Camera", camera, ["camera"]),
    pictures.row,
  );

  /** @param {Plan | null} plan @param {Port[]} ports @param {PlanFields | null} given @param {boolean} fixed */
  const show = (plan, ports, given, fixed) => {
    example = given;
    const real = ports.map(({ port, said }) => /** @type {Option} */ ([port, `${port}: ${said}`]));
    /** @param {HTMLSelectElement} control @param {Option[]} options @param {string} now */
    const fillWith = (control, options, now) => {
      fill(control, options.some(([value]) => value === now) ? options : [...options, [now, now]], now);
      control.disabled = fixed || !plan;
    };
    /** @returns {Option[]} */
    const simulated = (/** @type {"unit" | "scanner"} */ part) => (given ? [[given[part].port ?? "", "simulated"]] : []);
    fillWith(unit, [...simulated("unit"), ...real], plan?.unit?.port ?? "");
    const path = plan?.scanner?.kind === "folder" ? plan.scanner.folder ?? "" : null;
    const isTwin = path?.startsWith(TWIN_SCANNER) ?? false;
    const sends = plan?.scanner?.kind === PACKETS;
    const isTwinLidar = sends && Boolean(plan?.scanner?.host?.startsWith(TWIN_LIDAR));
    fillWith(
      scanner,
      [
        ...simulated("scanner").map(([port]) => /** @type {Option} */ ([port, "simulated line scanner"])),
        [TWIN_SCANNER, "simulated scanner with a field of view"],
        [TWIN_LIDAR, "simulated spinning lidar"],
        ...real,
        [FOLDER, "one with software of its own: watch its folder"],
        [PACKETS, "Ouster or Velodyne, by its packets"],
      ],
      sends ? (isTwinLidar ? TWIN_LIDAR : PACKETS) : path === null ? plan?.scanner?.port ?? "" : isTwin ? TWIN_SCANNER : FOLDER,
    );
    folder.row.hidden = path === null || isTwin;
    fov.row.hidden = path === null && !sends;
    for (const each of [port, host, sensor]) each.row.hidden = !sends || isTwinLidar;
    const shots = plan?.camera;
    const isVideo = shots && shots.folder === undefined;
    const isTwinCamera = Boolean(shots?.folder?.startsWith(TWIN_CAMERA));
    fillWith(
      camera,
      [
        ["", "none"],
        [TWIN_CAMERA, "simulated"],
        ...Array.from({ length: VIDEO_DEVICES }, (_, k) => /** @type {Option} */ ([String(k), `video device ${k}`])),
        [FOLDER, "one with software of its own: watch its folder"],
      ],
      !shots ? "" : isVideo ? String(shots.device) : isTwinCamera ? TWIN_CAMERA : FOLDER,
    );
    pictures.row.hidden = !shots || isVideo || isTwinCamera;
    for (const each of [folder, port, host, sensor, fov, pictures]) {
      each.show(plan);
      for (const input of each.row.querySelectorAll("input")) input.disabled = fixed;
    }
  };
  return { element: body, show };
};
