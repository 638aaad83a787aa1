/** Puts the page together. */

import { runs } from "./state/pipeline.js";
import { ask, connect, connectionState, fullReason, onConnection } from "./net/connection.js";
import { mountDividers } from "./layout/dividers.js";
import { mountDock } from "./layout/dock.js";
import { acceptDrops } from "./panels/drop.js";
import { openFiles } from "./panels/files.js";
import { mountFilling } from "./layout/maximise.js";
import { mountHeader } from "./panels/header.js";
import { linkHovering } from "./state/hover.js";
import { listenToPageKeys } from "./layout/shortcuts.js";
import { mountModelPane } from "./panels/model_pane.js";
import { notice, noticeArea } from "./ui/notices.js";
import { mountPanes } from "./panes/index.js";
import { mountStatusBar } from "./panels/status_bar.js";
import { store } from "./net/store.js";
import { followTheme } from "./ui/theme.js";
import { view } from "./state/view.js";

const OPENED = "ladarreg-opened";

const at = (id) => document.getElementById(id);
const part = (id, name) => at(id).querySelector(`.${name}`);

const floating = at("floating");
floating.append(noticeArea());
followTheme();
mountHeader(at("header"));
mountDock(at("dock"));
mountStatusBar(at("status"));
mountFilling(at("panes"));
mountModelPane(at("model-pane"));
mountDividers(at("workbench"), at("panes"));
mountPanes({
  scanHead: part("scan-pane", "pane-head"),
  scanBody: part("scan-pane", "pane-body"),
  photoHead: part("photo-pane", "pane-head"),
  photoBody: part("photo-pane", "pane-body"),
  store,
  view,
  ask,
});
listenToPageKeys();
linkHovering();
acceptDrops(floating);

store.onEvent("notice", ({ text, level }) => notice(text, level));

/** A job goes away unfinished only with the program that ran it. */
let running = null;
store.on("job", (job) => {
  if (running && !job) notice(`${running.label} ended unfinished when the workbench stopped: run it again.`, "bad");
  running = runs(job) ? job : null;
});

/** What is selected must exist. */
store.watch(["picks:*", "shown"], () => {
  const { selected, hovered } = view.get();
  const there = new Set(store.picksOf().map(({ id }) => id));
  const left = [...selected].filter((id) => there.has(id));
  if (left.length < selected.size) view.set({ selected: new Set(left), end: null });
  if (hovered && !there.has(hovered)) view.set({ hovered: null });
});

/** Once for each tab: a reload is not told again what was opened. */
const sayOnce = (text) => {
  try {
    if (!text || sessionStorage.getItem(OPENED) === text) return;
    sessionStorage.setItem(OPENED, text);
  } catch {
    // storage is off: it is said at each reload
  }
  notice(text);
};

/** Somebody who begins with nothing is asked for files, once. */
let welcomed = false;
const welcome = () => {
  if (welcomed || !store.get("project")) return;
  welcomed = true;
  if (store.get("project").amiss) notice(store.get("project").amiss, "warn");
  const nothing = !store.get("scan") && !(store.get("photos") ?? []).length;
  if (nothing && !document.querySelector("dialog[open]")) openFiles();
  else sayOnce(store.get("project").opened);
};
store.watch(["project", "scan", "photos"], welcome);

let wasLost = false;
onConnection((state) => {
  if (state === "connected" && wasLost) notice("Connected again.");
  if (state === "refused") notice(
    "The workbench no longer knows this page: open its address again, with the token that it printed.",
    "bad",
  );
  if (state === "full") notice(fullReason(), "bad");
  wasLost = state !== "connected";
});
if (connectionState() !== "connected") connect();
