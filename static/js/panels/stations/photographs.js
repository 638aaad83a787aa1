/** All photographs of the survey: how each stands, and the work on all of them together. */

import { request } from "../../net/requests.js";
import { store } from "../../net/store.js";
import { isRunning } from "../../state/pipeline.js";
import { ORDERS, SHOWN, rowsOf, summaryOf, tiesSaid } from "../../state/survey.js";
import { view } from "../../state/view.js";
import { button, fill } from "../../ui/controls.js";
import { element, setChildren, setText } from "../../ui/dom.js";
import { icon } from "../../ui/icons.js";
import { lightOf } from "../../ui/lights.js";
import { NONE, counted, fixed } from "../../ui/numbers.js";
import { thumbnail } from "../../ui/thumbnail.js";

/**
 * @typedef {import("../../state/survey.js").SurveyRow} SurveyRow
 */

const HEADS = [
  ["", ""],
  ["", "Photograph"],
  ["", "State"],
  ["Standard deviation of the camera's position", "σ"],
  ["Ties with other photographs that agree, and those that do not", "Ties"],
  ["Median residual of its ties", "px"],
];

/** @param {SurveyRow} row */
const tiesText = ({ ties, left_out }) => ties === null ? NONE : left_out ? `${ties} · ${left_out} out` : String(ties);

/** @param {{id: string, held: boolean}} camera @returns {HTMLElement} the tick box that holds its intrinsics */
const holding = (camera) => {
  const box = element("input", {
    type: "checkbox",
    checked: camera.held,
    "aria-label": `Hold ${camera.id}`,
    on: { change: () => request("hold_camera", { camera: camera.id, held: box.checked }) },
  });
  return element("label", { class: "check edits", title: "Adjustments keep this camera's intrinsics as they are now" }, box, "hold");
};

/** @returns {HTMLElement} */
export const mountPhotographs = () => {
  /** Ids of the photographs that are chosen for the work; empty: all. */
  const chosen = new Set();
  let order = "list", filter = "all", drawn = "";

  const wanted = () => {
    const there = new Set(store.photos().map(({ id }) => id));
    const ids = [...chosen].filter((id) => there.has(id));
    return ids.length ? ids : null;
  };
  const registerAll = button({ label: "Register all", kind: "small", act: () => request("register_all", { photos: wanted() }) });
  const adjust = button({ label: "Adjust", kind: "primary small", act: () => request("adjust", { photos: wanted() }) });
  const draw = button({ label: "Draw ties", text: "Ties", kind: "small", act: () => view.set({ tying: wanted()?.[0] ?? store.shown() }),
    title: "Draw ties by hand: a place in one photograph, and the same place in another; or a straight edge in several, and in the scan" });
  const orders = element("select", { class: "select small", "aria-label": "Order of the photographs" });
  const filters = element("select", { class: "select small", "aria-label": "Which photographs are listed" });
  orders.addEventListener("change", () => { order = orders.value; show(); });
  filters.addEventListener("change", () => { filter = filters.value; show(); });
  fill(orders, ORDERS, order);
  fill(filters, SHOWN, filter);
  const heads = element(
    "div",
    { class: "survey-row survey-heads dim", "aria-hidden": "true" },
    ...HEADS.map(([title, text]) => element("span", { title }, text)),
  );
  const setPart = (/** @type {"free" | "held" | "out"} */ part) => () => request("set_part", { photos: wanted() ?? [], part });
  const release = button({ label: "Release", kind: "small", act: setPart("free"),
    title: "Let the chosen photographs' poses be solved for again" });
  const hold = button({ label: "Hold poses", kind: "small", act: setPart("held"),
    title: "Keep the chosen photographs' poses as they are: adjustments move everything else" });
  const takeOut = button({ label: "Take out", kind: "small", act: setPart("out"),
    title: "Leave the chosen photographs out of adjustments; what moves is said after the next one" });
  const takeBack = button({ label: "Take back", kind: "small", act: setPart("free"),
    title: "Let the chosen photographs take part in adjustments again" });
  const parts = element(
    "div",
    { class: "survey-parts edits row", role: "group", "aria-label": "The chosen photographs" },
    hold, release, takeOut, takeBack,
  );
  const drawnTies = element("p", { class: "dim survey-ties" });
  const list = element("ul", { class: "survey-list", "aria-label": "Photographs of the survey" });
  const summary = element("p", { class: "acquire-said", role: "status" });
  const cameras = element("ul", { class: "survey-cameras dim", "aria-label": "Cameras of the survey" });
  const count = element("span", { class: "dim figures" });

  const row = (/** @type {SurveyRow} */ photo) => {
    const light = lightOf(photo.light);
    const check = element("input", {
      type: "checkbox",
      class: "edits",
      checked: chosen.has(photo.id),
      "aria-label": `Choose ${photo.name}`,
      on: {
        change: () => {
          check.checked ? chosen.add(photo.id) : chosen.delete(photo.id);
          show();
        },
      },
    });
    const name = element(
      "button",
      {
        type: "button",
        class: "survey-name",
        title: `Show ${photo.name}`,
        "aria-current": photo.id === store.shown() ? "true" : null,
        on: { click: () => request("show_photo", { photo: photo.id }) },
      },
      thumbnail(photo),
      element("span", { class: "clip" }, photo.name),
    );
    return element(
      "li",
      { class: `survey-photo ${photo.part === "out" ? "out" : ""}`.trim(), title: photo.reason },
      element(
        "div",
        { class: "survey-row" },
        element("label", { class: "survey-choice" }, check),
        name,
        element("span", { class: `clip ${light.level}` }, icon(light.sign), " ", photo.state),
        element("span", { class: "figures" }, photo.position),
        element("span", { class: "figures" }, tiesText(photo)),
        element("span", { class: "figures" }, fixed(photo.median_px, 2)),
      ),
      photo.accepted || !photo.reason ? null : element("p", { class: "dim survey-reason" }, photo.reason),
      photo.moved ? element("p", { class: "dim survey-reason" }, photo.moved) : null,
    );
  };

  const show = () => {
    const photos = store.photos(), survey = store.get("survey"), job = store.get("job");
    const idle = Boolean(store.get("scan")) && !isRunning(job) && !store.readOnly;
    const ids = wanted(), some = ids ? counted(ids.length, "chosen photograph") : "";
    registerAll.disabled = adjust.disabled = !idle || photos.length === 0;
    setText(registerAll, ids ? `Register ${ids.length}` : "Register all");
    setText(adjust, ids ? `Adjust ${ids.length}` : "Adjust");
    draw.disabled = photos.length < (store.get("scan")?.views?.length ? 1 : 2); // a line may be of one and the scan
    const byHand = (store.get("drawn_ties")?.length ?? 0) + (store.get("drawn_lines")?.length ?? 0);
    setText(draw, byHand ? `Ties ${byHand}` : "Ties");
    registerAll.title = ids
      ? `Register ${some} from the images, one after the other`
      : "Register all photographs that are not accepted yet from the images, one after the other";
    adjust.title = `Solve ${some || "all photographs"}, their cameras and all scans together; one step of the history`;
    const kinds = new Set(photos.filter(({ id }) => ids?.includes(id)).map(({ part }) => part));
    parts.hidden = !ids || store.readOnly;
    hold.hidden = kinds.has("out") || (kinds.has("held") && kinds.size === 1);
    hold.disabled = photos.some(({ id, state }) => ids?.includes(id) && state !== "accepted");
    release.hidden = !kinds.has("held");
    takeOut.hidden = kinds.has("out") && kinds.size === 1;
    takeBack.hidden = !kinds.has("out");
    setText(drawnTies, tiesSaid(store.get(`ties:${store.shown()}`), survey?.photos.find((/** @type {{id: string}} */ { id }) => id === store.shown())));
    drawnTies.hidden = !drawnTies.textContent;
    const rows = rowsOf(photos, survey, { order, filter });
    setText(count, photos.length ? `${photos.filter(({ state }) => state === "accepted").length} of ${photos.length} accepted` : "");
    const key = JSON.stringify([rows, survey, store.shown(), [...chosen], store.readOnly]);
    if (key === drawn) return;
    drawn = key;
    const { activeElement: active } = document;
    const focused = active && list.contains(active) ? active.getAttribute("aria-label") ?? active.textContent : null;
    setChildren(list, ...rows.map(row));
    /** @type {NodeListOf<HTMLElement>} */
    const controls = list.querySelectorAll("input, button");
    if (focused)
      [...controls].find((each) => (each.getAttribute("aria-label") ?? each.textContent) === focused)?.focus();
    heads.hidden = rows.length === 0;
    setText(summary, photos.length ? summaryOf(survey) : "Add photographs: those of one camera, and of one place, hold each other.");
    summary.classList.toggle("bad", Boolean(survey?.since));
    setChildren(
      cameras,
      ...(survey?.cameras ?? []).map(({ worst, ...camera }) => element(
        "li",
        { title: camera.photos.join(", ") },
        `${camera.id}, ${camera.width} × ${camera.height}: `,
        camera.focal_px === null ? "as given" : `f ${fixed(camera.focal_px, 1)} px`,
        camera.sigma_px === null ? "" : ` ± ${fixed(camera.sigma_px, 2)}`,
        `, ${counted(camera.used, "photograph")}`,
        camera.median_px === null ? "" : `, ties ${fixed(camera.median_px, 2)} px`,
        worst && camera.used > 1 ? element(
          "button",
          {
            type: "button",
            class: "survey-worst",
            title: `Show the photograph of this camera whose ties agree least: ${fixed(worst.median_px, 2)} px`,
            on: { click: () => request("show_photo", { photo: worst.id }) },
          },
          `worst ${worst.name}`,
        ) : null,
        store.readOnly || camera.focal_px === null ? null : holding(camera),
      )),
    );
  };
  store.watch(["photos", "survey", "drawn_ties", "drawn_lines", "ties:*", "shown", "scan", "job", "people"], show);
  const panel = element(
    "section",
    { class: "dock-part survey", "aria-label": "All photographs" },
    element(
      "div",
      { class: "part-head" },
      element("h2", {}, "All photographs"),
      count,
      element("div", { class: "end" }, filters, orders, draw, element("span", { class: "edits row" }, registerAll, adjust)),
    ),
    element("div", { class: "part-body" }, summary, drawnTies, parts, heads, list, cameras),
  );
  show();
  return panel;
};
