/** The status bar: readout under the cursor, hint of the current tool, job, saving, connection. */

import { connectionState, connectNow, onConnection } from "../../net/connection.js";
import { request } from "../../net/requests.js";
import { store } from "../../net/store.js";
import { isRunning, PIPELINE, shareDone } from "../../state/pipeline.js";
import { view } from "../../state/view.js";
import { button } from "../../ui/controls.js";
import { element, setAttribute, setChildren, setText } from "../../ui/dom.js";
import { icon } from "../../ui/icons.js";
import { lightOf } from "../../ui/lights.js";
import { duration, fixed, isNumber } from "../../ui/numbers.js";
import { jobControls } from "../pose/job_controls.js";
import { openKeys } from "./key_reference.js";

/** @typedef {import("../../net/store.js").Job} Job */

const CONNECTIONS = {
  connecting: ["running", "connecting", "dim"],
  connected: ["dot", "connected", "ok"],
  lost: ["warn", "not connected: trying again", "warn"],
  refused: ["bad", "refused: open the address with its token again", "bad"],
  full: ["warn", "too many pages are open: trying again", "warn"],
};
/** Jobs that end in a verdict: it is stated as the summary of the shown pose has it, whichever job has made that. */
const JUDGES = new Set([...PIPELINE.filter(({ stage }) => stage).map(({ job }) => job), "verify", "solve", "auto", "thesis", "compare"]);
/** @type {Record<string, [string, string]>} a finished job has no tick: whether its result is good is for the verdict to say */
const ENDS = { done: ["info", "dim"], failed: ["bad", "bad"], stopped: ["stop", "warn"] };
const LONG_S = 2;

/** @param {number | null | undefined} range */
const rangeText = (range) => (range === undefined ? "" : range === null ? "no return" : `${fixed(range, 3)} m`);

/** @param {NonNullable<import("../../state/view.js").ViewState["readout"]>} readout @returns {string} */
const readoutText = ({ uv, range_m: range, intensity, edge, zoom }) =>
  [
    `u ${fixed(uv[0], 2)}  v ${fixed(uv[1], 2)}`,
    edge ? `edge: ${fixed(edge.near_m, 2)} m, behind it ${fixed(edge.far_m, 2)} m` : rangeText(range),
    isNumber(intensity) ? `intensity ${fixed(intensity, 2)}` : "",
    isNumber(zoom) ? `×${fixed(zoom, zoom < 10 ? 2 : 0)}` : "",
  ].filter(Boolean).join(" · ");

/** The verdict on the shown pose in one line. @param {import("../../net/store.js").Stage} stage */
const verdictNow = ({ label, stale, summary }) => ({
  ...lightOf(summary?.light),
  said: stale ? `Out of date: ${stale}` : [`${label}: ${summary?.line ?? ""}`, summary?.matches].filter(Boolean).join(" · "),
});

const jobBar = () => {
  const sign = element("span", { class: "sign" });
  const text = element("span", { class: "clip" });
  const bar = element("progress", { max: 1 });
  const waiting = element("span", { class: "job-waiting" });
  const box = element("div", { class: "job-bar", role: "group", "aria-label": "Job" }, sign, text, bar, jobControls(), waiting);
  const announcement = element("span", { class: "visually-hidden", role: "status" }); // at the start and the end
  const setSign = (/** @type {string} */ shape, /** @type {string} */ level) => {
    if (sign.dataset.shape !== shape) setChildren(sign, icon(shape));
    sign.dataset.shape = shape;
    sign.className = `sign ${level}`;
  };
  /** @param {Job} job @param {boolean} busy */
  const showJob = (job, busy) => {
    if (busy) setSign(job.state === "paused" ? "pause" : "running", "accent");
    else setSign(...(ENDS[job.state] ?? ENDS.done));
    const seconds = busy || job.seconds >= LONG_S ? duration(job.seconds) : "";
    const named = job.said?.startsWith(job.label); // the text already contains the label
    setText(
      text,
      [
        named ? "" : job.label,
        job.state === "paused" ? "paused" : "",
        job.said || (busy ? (job.steps?.at(-1)?.label ?? "") : job.state),
        seconds,
      ].filter(Boolean).join(" · "),
    );
    text.title = [
      text.textContent,
      ...(job.steps ?? []).map(
        (/** @type {{label: string, seconds: number, said: string}} */ { label, seconds: took, said }) => `${label}: ${duration(took)}${said ? `, ${said}` : ""}`,
      ),
    ].join("\n");
  };
  let listed = "";
  /** The jobs that begin after this one; each can be cancelled. @param {import("../../protocol.d.ts").WaitingJob[]} jobs */
  const showWaiting = (jobs) => {
    const names = new Map(store.photos().map(({ id, name }) => [id, name]));
    const key = JSON.stringify([jobs, [...names], store.readOnly]);
    if (key === listed) return;
    listed = key;
    const chip = (/** @type {import("../../protocol.d.ts").WaitingJob} */ { id, label, photo, author }) => {
      const what = [label, names.get(photo)].filter(Boolean).join(", ");
      const title = `${what}: waits${author ? `, started by ${author}` : ""}`;
      return store.readOnly
        ? element("span", { class: "clip", title }, names.get(photo) ?? label)
        : button({
          label: `Cancel: ${what}`,
          title: `${title}; click to cancel it`,
          text: names.get(photo) ?? label,
          icon: "close",
          kind: "small plain",
          act: () => request("job_control", { action: "stop", job: id }),
        });
    };
    const later = jobs.slice(1);
    const title = later.map(({ label, photo }) => [label, names.get(photo)].filter(Boolean).join(", ")).join("\n");
    setChildren(
      waiting,
      jobs.length ? "then " : "",
      ...jobs.slice(0, 1).map(chip),
      later.length ? element("span", { class: "dim", title }, `and ${later.length} more`) : null,
    );
  };
  const show = () => {
    const job = store.get("job");
    const busy = isRunning(job);
    showWaiting(busy && job ? job.waiting : []);
    // a finished job goes with what it worked on
    const open = job?.photo ? store.photos().some(({ id }) => id === job.photo) : store.get("scan");
    const own = !job?.photo || job.photo === store.shown();
    const told = job && (busy || (open && own && !(job.state === "done" && JUDGES.has(job.kind)))) ? job : null;
    const stage = store.stageOf();
    const share = shareDone(job);
    const judged = !busy && stage && (!told || stage.stale) ? verdictNow(stage) : null;
    box.hidden = !told && !judged;
    if (box.hidden) setText(text, "");
    else if (judged) {
      setSign(judged.sign, judged.level);
      setText(text, judged.said);
      text.title = judged.said;
    } else if (told) showJob(told, busy);
    bar.hidden = !busy;
    if (share === null) bar.removeAttribute("value");
    else bar.value = share;
    setAttribute(bar, "aria-label", `${job?.label ?? "Job"}, progress`);
    setText(announcement, busy ? `${job?.label} started` : judged ? judged.said : told ? `${told.label}: ${told.state}. ${told.said}` : "");
  };
  store.watch(["job", "poses:*", "shown", "photos", "scan"], show);
  show();
  return [box, announcement];
};

/** @param {HTMLElement} footer */
export const mountStatusBar = (footer) => {
  const readout = element("span", { class: "readout figures" });
  const hint = element("span", { class: "hint clip" });
  const keys = button({ label: "Keys ?", kind: "plain small", title: "Keyboard reference (?)", "data-needs": "keyboard", act: openKeys });
  const saved = element("span", { class: "saved" });
  const sign = element("span", { class: "sign" });
  const label = element("span", {});
  const connection = element(
    "button",
    { type: "button", class: "button plain small connection", on: { click: connectNow } },
    sign,
    label,
  );
  const announcement = element("span", { class: "visually-hidden", role: "status" });
  footer.append(readout, hint, keys, ...jobBar(), element("div", { class: "end" }, saved, connection, announcement));

  const showSaved = () => {
    const project = store.get("project");
    saved.classList.toggle("warn", Boolean(project?.unsaved));
    setText(saved, project ? (project.unsaved ? "NOT SAVED: retrying" : project.saved_at ? `saved ${project.saved_at}` : "") : "");
    saved.title = project?.unsaved
      ? `${project.unsaved_why}. Saving is retried every 5 s; unsaved edits are lost if the computer stops.`
      : "Every edit is saved automatically";
  };
  const showConnection = () => {
    const [shape, text, level] = CONNECTIONS[connectionState()];
    setChildren(sign, icon(shape));
    sign.className = `sign ${level}`;
    setText(label, text);
    setText(announcement, text);
    connection.title = connectionState() === "connected" ? "Connected to the workbench" : "Click to reconnect now";
    document.body.dataset.connection = connectionState();
  };
  const showView = () => {
    const { readout: values, hint: text } = view.get();
    setText(readout, values ? readoutText(values) : "");
    setText(hint, text ?? "");
    hint.title = text ?? "";
  };
  view.on((_, changed) => (changed.has("readout") || changed.has("hint")) && showView());
  store.watch(["project"], showSaved);
  onConnection(showConnection);
  showSaved();
  showConnection();
  showView();
};
