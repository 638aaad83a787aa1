/** The lowest line: what is under the cursor, what the tool expects, the job, what was saved, the connection. */

import { runs, shareDone } from "../state/pipeline.js";
import { attribute, button, element, put, say } from "../ui/dom.js";
import { connectionState, connectNow, onConnection } from "../net/connection.js";
import { icon } from "../ui/icons.js";
import { jobControls } from "./job_controls.js";
import { openKeys } from "./keys_dialog.js";
import { duration, fixed } from "../ui/numbers.js";
import { store } from "../net/store.js";
import { view } from "../state/view.js";

const CONNECTIONS = {
  connecting: ["running", "connecting", "dim"],
  connected: ["dot", "connected", "ok"],
  lost: ["warn", "not connected: trying again", "warn"],
  refused: ["bad", "refused: open the address with its token again", "bad"],
  full: ["warn", "too many pages are open: trying again", "warn"],
};
/** Done is not yet good: the verdict on the pose says that. */
const ENDS = { done: ["tick", "dim"], failed: ["bad", "bad"], stopped: ["stop", "warn"] };
const LONG_S = 2;

const readoutText = ({ uv, range_m: range, intensity, zoom }) =>
  [
    `u ${fixed(uv[0], 2)}  v ${fixed(uv[1], 2)}`,
    range === undefined ? "" : range === null ? "no return" : `${fixed(range, 3)} m`,
    Number.isFinite(intensity) ? `intensity ${fixed(intensity, 2)}` : "",
    Number.isFinite(zoom) ? `×${fixed(zoom, zoom < 10 ? 2 : 0)}` : "",
  ].filter(Boolean).join(" · ");

const jobBar = () => {
  const sign = element("span", { class: "sign" });
  const text = element("span", { class: "clip" });
  const bar = element("progress", { max: 1 });
  const box = element("div", { class: "job-bar", role: "group", "aria-label": "Job" }, sign, text, bar, jobControls());
  const told = element("span", { class: "told", role: "status" }); // heard once when it begins and once when it ends
  const show = () => {
    const job = store.get("job");
    box.hidden = !job;
    if (!job) return;
    const busy = runs(job);
    const share = shareDone(job);
    const [shape, level] = busy ? [
      job.state === "paused" ? "pause" : "running",
      "accent",
    ] : (ENDS[job.state] ?? ENDS.done);
    if (sign.dataset.shape !== shape) put(sign, icon(shape));
    sign.dataset.shape = shape;
    sign.className = `sign ${level}`;
    const seconds = busy || job.seconds >= LONG_S ? duration(job.seconds) : "";
    const names = job.said?.startsWith(job.label); // said with its own name
    say(
      text,
      [
        names ? "" : job.label,
        job.state === "paused" ? "paused" : "",
        job.said || (busy ? (job.steps?.at(-1)?.name ?? "") : job.state),
        seconds,
      ].filter(Boolean).join(" · "),
    );
    text.title = [
      text.textContent,
      ...(job.steps ?? []).map(
        ({ name, seconds: took, said }) => `${name}: ${duration(took)}${said ? `, ${said}` : ""}`,
      ),
    ].join("\n");
    bar.hidden = !busy;
    if (share === null) bar.removeAttribute("value");
    else bar.value = share;
    attribute(bar, "aria-label", `${job.label}, progress`);
    say(told, busy ? `${job.label} began` : `${job.label}: ${job.state}. ${job.said ?? ""}`);
  };
  store.watch(["job"], show);
  show();
  return [box, told];
};

/** @param {HTMLElement} footer */
export const mountStatusBar = (footer) => {
  const readout = element("span", { class: "readout figures" });
  const hint = element("span", { class: "hint clip" });
  const keys = button({ label: "all keys ?", kind: "plain small", title: "Keyboard reference (?)", act: openKeys });
  const saved = element("span", { class: "saved" });
  const sign = element("span", { class: "sign" });
  const word = element("span", {});
  const connection = element(
    "button",
    { type: "button", class: "button plain small connection", on: { click: connectNow } },
    sign,
    word,
  );
  const spoken = element("span", { class: "told", role: "status" });
  footer.append(readout, hint, keys, ...jobBar(), element("div", { class: "end" }, saved, connection, spoken));

  const showSaved = () => {
    const project = store.get("project");
    saved.classList.toggle("warn", Boolean(project?.unsaved));
    say(saved, project ? (project.unsaved ? "NOT SAVED: trying again" : project.saved_at ? `saved ${project.saved_at}` : "") : "");
    saved.title = project?.unsaved
      ? `${project.unsaved_why}. It is tried again every 5 s; what is done meanwhile is lost if the machine stops.`
      : "Everything is saved with every step";
  };
  const showConnection = () => {
    const [shape, text, level] = CONNECTIONS[connectionState()];
    put(sign, icon(shape));
    sign.className = `sign ${level}`;
    say(word, text);
    say(spoken, text);
    connection.title = connectionState() === "connected" ? "Connected to the workbench" : "Click to try at once";
    document.body.dataset.connection = connectionState();
  };
  const showView = () => {
    const { readout: read, hint: said } = view.get();
    say(readout, read ? readoutText(read) : "");
    say(hint, said ?? "");
    hint.title = said ?? "";
  };
  view.on((_, changed) => (changed.has("readout") || changed.has("hint")) && showView());
  store.watch(["project"], showSaved);
  onConnection(showConnection);
  showSaved();
  showConnection();
  showView();
};
