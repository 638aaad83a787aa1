/** Pause, step, stop and speed of the job that runs, as far as it can. */

import { runs } from "../state/pipeline.js";
import { button, element, put } from "../ui/dom.js";
import { wish } from "../net/requests.js";
import { icon } from "../ui/icons.js";
import { store } from "../net/store.js";

/** Iterations a second; 0 is as fast as it goes. */
const SPEEDS = [[2, "2 a second"], [10, "10 a second"], [60, "60 a second"], [240, "240 a second"], [0, "full speed"]];
const KEEPS_BEST = new Set(["simplex", "reject_outliers"]);

/**
 * @param {{kinds?: string[] | null}} [options] of jobs that it is for; null: of all
 * @returns {HTMLElement} hidden while nothing of these runs
 */
export const jobControls = ({ kinds = null } = {}) => {
  const control = (action, value) => wish("job_control", value === undefined ? { action } : { action, value });
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
  speed.value = "60";
  const box = element("span", { class: "job-controls" }, pause, step, speed, stop);
  let job = null;
  const show = () => {
    const now = store.get("job");
    box.hidden = !runs(now) || (kinds !== null && !kinds.includes(now.kind));
    if (box.hidden) return;
    if (now.id !== job) {
      job = now.id;
      speed.value = String(now.speed ?? 60);
    }
    const can = now.can ?? [];
    pause.hidden = !can.includes("pause");
    step.hidden = !can.includes("step");
    stop.hidden = !can.includes("stop");
    speed.hidden = !can.includes("speed");
    const paused = now.state === "paused";
    put(pause, icon(paused ? "play" : "pause"));
    pause.title = paused ? "Resume" : "Pause";
    pause.setAttribute("aria-label", pause.title);
    const best = KEEPS_BEST.has(now.kind);
    put(stop, icon("stop"), element("span", {}, best ? "Keep best" : "Stop"));
    stop.title = best ? "Stop, and keep the best so far" : "Stop";
  };
  store.watch(["job"], show);
  show();
  return box;
};
