/** Stations: scans of the same place from elsewhere, where they stand, and how well they fit each other. */

import { sendFile } from "../../net/uploads.js";
import { request } from "../../net/requests.js";
import { store } from "../../net/store.js";
import { isRunning } from "../../state/pipeline.js";
import { isRegistered, placeText, sigmaText, stateText, stationName, stationsNow } from "../../state/stations.js";
import { button, fill } from "../../ui/controls.js";
import { element, setChildren, setText } from "../../ui/dom.js";
import { messageOf, wasCancelled } from "../../ui/faults.js";
import { notice } from "../../ui/notices.js";

/** @type {["x" | "y" | "z" | "yaw_deg", string][]} */
const FIELDS = [["x", "x, m"], ["y", "y, m"], ["z", "z, m"], ["yaw_deg", "turn, °"]];
/** @type {[NonNullable<Commands["register_stations"]["poses"]>, string][]} */
const POSES = [["refine", "Refine poses"], ["keep", "Keep poses"], ["search", "Ignore poses"]];
/** @type {Record<string, string>} */
const SIGNS = { verified: "ok", ambiguous: "warn", refused: "bad", contradicted: "bad", undecidable: "warn" };

/**
 * @typedef {import("../../net/requests.js").Commands} Commands
 * @typedef {import("../../state/stations.js").Station} Station
 * @typedef {import("../../state/progress.js").Target} Target
 */

/** Controls that give a station a rough place: numbers, from the scan that is shown. @param {Station} station @param {string} id */
const placeForm = (station, id) => {
  const place = station.place ?? { x: 0, y: 0, z: 0, yaw_deg: 0 };
  const inputs = FIELDS.map(([field, label]) => {
    const input = element("input", {
      type: "number",
      class: "number short",
      step: field === "yaw_deg" ? 5 : 0.1,
      value: String(Number(place[field].toFixed(3))),
      "aria-label": `${label} of ${stationName(station)}`,
    });
    input.addEventListener("change", () => {
      const numbers = Object.fromEntries(FIELDS.map(([name], k) => [name, inputs[k].input.valueAsNumber]));
      if (Object.values(numbers).every(Number.isFinite)) request("place_station", { station: id, place: numbers });
    });
    return { input, label };
  });
  return element(
    "div",
    { class: "station-place", role: "group", "aria-label": `Rough place of ${stationName(station)}` },
    ...inputs.map(({ input, label }) => element("label", { class: "plan-number" }, element("span", { class: "dim" }, label), input)),
    station.rough
      && button({ label: `Forget the place of ${stationName(station)}`, text: "Forget", kind: "small",
        act: () => request("place_station", { station: id, place: null }) }),
  );
};

/** @returns {HTMLElement[]} the two panels of the step */
export const mountStations = () => {
  const open = new Set(); // ids of stations whose place is being entered
  let savesZip = false;

  const file = element("input", { type: "file", multiple: true, hidden: true, "aria-hidden": "true", tabindex: -1 });
  file.addEventListener("change", async () => {
    const files = [...(file.files ?? [])];
    file.value = "";
    for (const each of files) {
      setText(said, `Sending ${each.name} …`);
      try {
        await sendFile(each, {
          what: "station",
          progress: (share) => setText(said, share < 1 ? `Sending ${each.name}: ${Math.round(100 * share)} %` : `Reading ${each.name} …`),
        }).finished;
      } catch (error) {
        if (!wasCancelled(error)) notice(messageOf(error), "bad");
      }
    }
    show();
  });
  const served = element("select", { class: "select small", "aria-label": "Add a scan of the served folder" });
  served.addEventListener("change", () => {
    const path = served.value;
    served.value = "";
    if (path) request("open_served", { path, what: "station" });
  });
  const add = button({ label: "Add scans", kind: "small", icon: "plus", act: () => file.click() });
  const poses = element("select", {
    class: "select small",
    "aria-label": "Poses in the files",
    title: "What the poses in the files are used for; how well the scans agree at them is stated in any case",
  });
  fill(poses, POSES, "refine");
  const register = button({
    label: "Register",
    kind: "primary small",
    act: () => request("register_stations", { poses: POSES.find(([value]) => value === poses.value)?.[0] }),
  });
  const check = button({
    label: "Check photographs",
    kind: "small",
    title: "Verify the poses of the registered photographs by the scans of the other stations",
    act: () => request("check_at_stations"),
  });
  const save = button({
    label: "Export all stations",
    text: "Export",
    kind: "small",
    title: "A zip of all scans with their poses, as files of their own and as one E57",
    act: async () => {
      const { targets } = (await request("export_targets", { photos: [] })) ?? { targets: [] };
      const written = ["stations", "e57"].filter((name) => name === "stations" || targets.some((/** @type {Target} */ target) => target.name === name && !target.refusal));
      savesZip = Boolean(await request("export", { targets: written, photos: [] }));
    },
  });
  const said = element("p", { class: "acquire-said", role: "status" });
  const list = element("ul", { class: "station-list", "aria-label": "Stations" });
  const stations = element(
    "section",
    { class: "dock-part stations", "aria-label": "Stations" },
    element(
      "div",
      { class: "part-head" },
      element("h2", {}, "Stations"),
      element("div", { class: "end edits" }, served, add, poses, register, check, save, file),
    ),
    element("div", { class: "part-body" }, list, said),
  );
  const verdicts = element("ul", { class: "station-verdicts", "aria-label": "Verdicts" });
  const whole = element("p", { class: "acquire-said" });
  const fit = element(
    "section",
    { class: "dock-part station-fit", "aria-label": "How the stations fit" },
    element("div", { class: "part-head" }, element("h2", {}, "How they fit")),
    element("div", { class: "part-body" }, whole, verdicts),
  );

  const hidden = () => new Set(store.get("model")?.hidden_stations ?? []);
  const toggle = (/** @type {string} */ id, /** @type {boolean} */ shown) => {
    const next = hidden();
    shown ? next.delete(id) : next.add(id);
    request("set_model", { hidden_stations: [...next] });
  };

  /** @param {Station} station @param {string} id @param {string} name */
  const pointsBox = (station, id, name) => {
    const box = element("input", {
      type: "checkbox",
      class: "station-mark",
      checked: !hidden().has(id),
      disabled: !station.place,
      title: station.place ? "Show its points in the 3-D view" : "Its place is not known yet",
      "aria-label": `Show the points of ${name}`,
      on: { change: () => toggle(id, box.checked) },
    });
    return box;
  };

  /** @param {Station} station */
  const row = (station) => {
    const name = stationName(station);
    const { id } = station;
    const mark = id === null
      ? element("span", { class: "station-mark", title: "The scan that is shown" })
      : pointsBox(station, id, name);
    if (station.colour) mark.style.setProperty("--station", station.colour);
    /** @param {string} label @param {string} text @param {() => void} run @param {string} title @param {boolean} [pressed] */
    const act = (label, text, run, title, pressed) => button({
      label: `${label} ${name}`, text, kind: "small", title, act: run, disabled: store.readOnly,
      ...(pressed === undefined ? {} : { "aria-expanded": String(pressed) }),
    });
    return element(
      "li",
      { class: "station" },
      mark,
      element("span", { class: "station-name", title: name }, name),
      element("span", { class: `station-state ${["out", "stated"].includes(station.state) ? "warn" : "dim"}` }, stateText(station)),
      element("span", { class: "figures dim station-where" }, id === null ? "" : placeText(station)),
      id === null
        ? element("span", {})
        : element(
          "span",
          { class: "station-acts edits" },
          act("Show", "Show", () => request("show_station", { station: id }), "Show its scan; photographs are registered to it then, and what was done here is kept"),
          act("Place", "Place", () => {
            open.has(id) ? open.delete(id) : open.add(id);
            show();
          }, "Enter roughly where it stands, for a search that is not sure", open.has(id)),
          act("Remove", "Remove", () => request("remove_station", { station: id }), "Remove it from the project; this can be undone"),
        ),
      id !== null && open.has(id) && !store.readOnly && placeForm(station, id),
    );
  };

  /** @param {string} sign @param {string} head @param {string} text */
  const verdict = (sign, head, text, faded = false) => element(
    "li",
    { class: faded ? "dim" : "" },
    element("span", { class: `station-verdict ${sign}` }, head),
    element("span", {}, text),
  );

  let drawn = "";
  const show = () => {
    const { stations: all, pairs, loops, reasons, checks, stale, registered } = stationsNow();
    const job = store.get("job");
    const busy = isRunning(job);
    const scan = store.get("scan");
    add.disabled = served.disabled = !scan || store.readOnly;
    register.disabled = all.length < 2 || busy || store.readOnly;
    poses.disabled = register.disabled;
    register.classList.toggle("primary", !isRegistered());
    check.disabled = save.disabled = !isRegistered() || busy || store.readOnly;
    const files = store.get("served")?.files ?? [];
    const scans = files.filter(({ kind }) => kind === "scan");
    served.hidden = !scans.length;
    fill(served, [["", "Add from folder …"], ...scans.map(({ path }) => /** @type {[string, string]} */ ([path, path]))], "");
    setText(said, !scan
      ? "Open a scan first; scans of the same place from elsewhere are added to it here."
      : all.length < 2
        ? "Add scans of the same place from elsewhere. They are registered by their surfaces: neighbouring stations must see the same walls, and each scanner stood upright."
        : "");
    const survey = store.get("survey");
    const placed = !pairs.length && survey && survey.scans.length > 1 ? survey.scans : [];
    const key = JSON.stringify([all, pairs, loops, reasons, checks, stale, placed, survey?.since, [...hidden()], [...open], store.readOnly]);
    if (key === drawn || list.contains(document.activeElement) && document.activeElement?.matches("input[type=number]")) return;
    drawn = key;
    const focused = document.activeElement?.getAttribute("aria-label");
    setChildren(list, ...all.map(row));
    /** @type {NodeListOf<HTMLElement>} */
    const named = list.querySelectorAll("[aria-label]");
    if (focused && !list.contains(document.activeElement))
      [...named].find((each) => each.getAttribute("aria-label") === focused)?.focus();
    setText(whole, !registered
      ? ""
      : stale ? "Stations have come or gone since, or got further clouds: register them again." : reasons.join(" "));
    whole.classList.toggle("bad", stale);
    whole.hidden = !whole.textContent;
    setChildren(
      verdicts,
      ...pairs.map((pair) => verdict(
        SIGNS[pair.verdict], `${pair.first} – ${pair.second}: ${pair.verdict}`,
        [pair.verdict === "verified" && sigmaText(pair) ? `${sigmaText(pair)}.` : "", ...pair.reasons].filter(Boolean).join(" "), stale,
      )),
      ...loops.map((loop) => verdict(
        loop.error_mm < 10 ? "ok" : "warn", `Loop ${loop.stations.join(" → ")}`,
        `closes within ${loop.error_mm.toFixed(1)} mm and ${loop.error_deg.toFixed(3)}°.`, stale,
      )),
      ...placed.map(({ name, state, position, angle }) => verdict(
        state === "not connected" ? "bad" : "ok",
        `${name}: ${state === "placed" ? "placed by adjusting everything together" : state}`,
        state === "placed" ? `σ ${position}, ${angle}.` : "",
        Boolean(survey?.since),
      )),
      ...checks.map((each) => verdict(
        SIGNS[each.outcome], `${each.name} at ${each.station}: ${each.outcome}`,
        each.stale ? "The photograph has another pose by now: check it again." : each.sentence, stale || each.stale,
      )),
    );
  };
  store.watch(["stations", "survey", "scan", "job", "model", "served", "people"], show);
  list.addEventListener("focusout", () => setTimeout(show));
  store.onEvent("export_ready", ({ targets, url }) => {
    if (savesZip && targets.includes("stations")) element("a", { href: url, download: "" }).click();
    savesZip = false;
  });
  show();
  return [stations, fit];
};
