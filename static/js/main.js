/** Assembly of the page. */

import { mountDividers } from "./layout/dividers.js";
import { mountDock } from "./layout/dock.js";
import { mountMaximise } from "./layout/maximise.js";
import { followAccess } from "./layout/read_only.js";
import { listenToShortcuts } from "./layout/shortcuts.js";
import { mountSwitcher } from "./layout/switcher.js";
import { ask, connect, connectionState, fullReason, onConnection } from "./net/connection.js";
import { rememberPhoto } from "./net/identity.js";
import { store } from "./net/store.js";
import { mountLiveScan } from "./panels/acquire/live_scan.js";
import { acceptDrops } from "./panels/files/drop.js";
import { offeredPictures } from "./panels/files/embedded_pictures.js";
import { openFiles } from "./panels/files/files.js";
import { mountHeader } from "./panels/project/header.js";
import { mountModelPane } from "./panels/model/model_pane.js";
import { mountFramesButton } from "./panels/files/scan_clouds.js";
import { openProjects } from "./panels/project/start_page.js";
import { mountStatusBar } from "./panels/project/status_bar.js";
import { mountPanes } from "./panes/index.js";
import { mountTiePictures } from "./panes/tie_pictures.js";
import { linkHovering } from "./state/hover.js";
import { isRunning } from "./state/pipeline.js";
import { followProject, projectNotice } from "./state/project.js";
import { view } from "./state/view.js";
import { byId, partOf } from "./ui/dom.js";
import { dropOutdated, notice, noticeArea } from "./ui/notices.js";
import { followTheme } from "./ui/theme.js";

const OPENED = "ladarreg-opened";

const floating = byId("floating");
floating.append(noticeArea());
followTheme();
mountHeader(byId("header"));
mountDock(byId("dock"));
mountStatusBar(byId("status"));
mountMaximise(byId("panes"));
const model = mountModelPane(byId("model-pane"));
mountDividers(byId("workbench"), byId("panes"));
mountSwitcher(byId("workbench"));
mountPanes({
  scanHead: partOf(document, "#scan-pane .pane-head"),
  scanBody: partOf(document, "#scan-pane .pane-body"),
  photoHead: partOf(document, "#photo-pane .pane-head"),
  photoBody: partOf(document, "#photo-pane .pane-body"),
  model,
  store,
  view,
  ask,
});
mountTiePictures({ store, view });
mountFramesButton(partOf(document, "#scan-pane .pane-head"), () => openFiles("frames"));
mountLiveScan(partOf(document, "#scan-pane .pane-body"));
listenToShortcuts();
followAccess();
linkHovering();
acceptDrops(floating);

store.on("shown", rememberPhoto);
/** What a notice on a photograph speaks of: its matches and the verdict on its pose. */
const subjectOf = (/** @type {string} */ photo) => () => {
  const stage = store.stageOf(photo);
  return [store.picksOf(photo), stage?.stage, stage?.summary?.light, stage?.centre];
};
store.onEvent("notice", ({ text, level, photo }) => notice(text, level, undefined, photo ? subjectOf(photo) : undefined));
store.watch(["picks:*", "poses:*", "photos"], dropOutdated);

/** A scan may bring its own pictures: offer them where the dialog does not. */
store.on("embedded", () => {
  const count = offeredPictures().length;
  if (!count || store.photos().length || document.querySelector("dialog[open]")) return;
  const pictures = count === 1 ? "a picture" : `${count} pictures`;
  notice(`The scan contains ${pictures}, which may be used as photographs.`, "info", { label: "Show", act: () => openFiles() });
});

/** A running job disappears only if the workbench has stopped. */
/** @type {{label: string} | null} */
let running = null;
store.on("job", (job) => {
  if (running && !job) notice(`${running.label} was interrupted when the workbench stopped: run it again.`, "bad");
  running = isRunning(job) ? job : null;
});

/** Deselect matches that no longer exist. */
store.watch(["picks:*", "shown"], () => {
  const { selected, hovered } = view.get();
  const existing = new Set(store.picksOf().map(({ id }) => id));
  const left = [...selected].filter((id) => existing.has(id));
  if (left.length < selected.size) view.set({ selected: new Set(left), end: null });
  if (hovered && !existing.has(hovered)) view.set({ hovered: null });
});

/** Show what was opened once for each tab, not again after a reload. */
const noticeOnce = (/** @type {string} */ text) => {
  try {
    if (!text || sessionStorage.getItem(OPENED) === text) return;
    sessionStorage.setItem(OPENED, text);
  } catch {
    // storage is disabled: it is shown after each reload
  }
  notice(text);
};

/** Open the file dialog once if the project is empty. */
let welcomed = false;
const welcome = () => {
  const project = store.get("project");
  if (welcomed || !project) return;
  welcomed = true;
  if (project.amiss) notice(project.amiss, "warn");
  const left = store.get("waiting") ?? [];
  if (left.length) notice(
    left.length === 1 ? `${left[0].name} is not open yet: ${left[0].said}.` : `${left.length} files are not open yet.`,
    "warn",
    { label: "Show", act: () => openFiles() },
  );
  const nothing = !store.get("scan") && !store.photos().length;
  const message = projectNotice();
  if (message) notice(message);
  if (nothing && store.get("acquisition")?.offered && !store.readOnly) view.set({ step: "acquire" });
  else if (project.start && !store.readOnly) openProjects(openFiles);
  else if (nothing && !store.readOnly && !document.querySelector("dialog[open]")) openFiles();
  else noticeOnce(project.opened);
};
store.watch(["project", "scan", "photos", "acquisition"], welcome);

followProject();

let wasLost = false;
onConnection((state) => {
  if (state === "connected" && wasLost) notice("Reconnected.");
  if (state === "refused") notice(
    "The workbench no longer accepts this page: open its address again, with the token that it printed.",
    "bad",
  );
  if (state === "full") notice(fullReason(), "bad");
  wasLost = state !== "connected";
});
if (connectionState() !== "connected") connect();
