/** Controls of the running job: pause, step, stop and speed, as far as it supports them. */

import { request } from "../../net/requests.js";
import { store } from "../../net/store.js";
import { runningJob } from "../../state/pipeline.js";
import { button } from "../../ui/controls.js";
import { element, setChildren } from "../../ui/dom.js";
import { icon } from "../../ui/icons.js";

/** The speed that is unlimited, as the server names it. */
const FULL_SPEED = 0;
/** Speed of a job that does not state its own, iterations per second. */
const DEFAULT_SPEED = 60;
const LIMITED_SPEEDS = [2, 10, DEFAULT_SPEED, 240];
/** @type {[number, string][]} */
const SPEEDS = [...LIMITED_SPEEDS.map((speed) => /** @type {[number, string]} */ ([speed, `${speed} per second`])), [FULL_SPEED, "full speed"]];
const KEEPS_BEST = new Set(["simplex", "reject_outliers"]);

/**
 * @param {{kinds?: string[] | null}} [options] kinds of jobs that are controlled; null for all
 * @returns {HTMLElement} hidden while no such job is running
 */
export const jobControls = ({ kinds = null } = {}) => {
  /** @param {string} action @param {number} [value] */
  const control = (action, value) => request("job_control", value === undefined ? { action } : { action, value });
  const pause = button({
    label: "Pause",
    icon: "pause",
    bare: true,
    kind: "small",
    act: () => control(store.get("job")?.state === "paused" ? "resume" : "pause"),
  });
  const step = button({ label: "One step", icon: "next", bare: true, kind: "small", act: () => control("step") });
  const stop = button({ label: "Stop", icon: "stop", kind: "small", act: () => control("stop") });
  const speed = element(
    "select",
    {
      class: "select small",
      "aria-label": "Speed",
      title: "Speed",
      on: { change: () => control("speed", Number(speed.value)) },
    },
    ...SPEEDS.map(([value, label]) => element("option", { value }, label)),
  );
  speed.value = String(DEFAULT_SPEED);
  const box = element("span", { class: "job-controls edits" }, pause, step, speed, stop);
  /** @type {string | null} */
  let job = null;
  const show = () => {
    const now = runningJob(store.get("job"));
    box.hidden = !now || (kinds !== null && !kinds.includes(now.kind));
    if (!now || box.hidden) return;
    if (now.id !== job) {
      job = now.id;
      speed.value = String(now.speed);
    }
    const { can } = now;
    pause.hidden = !can.includes("pause");
    step.hidden = !can.includes("step");
    stop.hidden = !can.includes("stop");
    speed.hidden = !can.includes("speed");
    const paused = now.state === "paused";
    setChildren(pause, icon(paused ? "play" : "pause"));
    pause.title = paused ? "Resume" : "Pause";
    pause.setAttribute("aria-label", pause.title);
    const best = KEEPS_BEST.has(now.kind);
    setChildren(stop, icon("stop"), element("span", {}, best ? "Keep best" : "Stop"));
    stop.title = best ? "Stop, and keep the best pose so far" : "Stop";
  };
  store.watch(["job"], show);
  show();
  return box;
};
