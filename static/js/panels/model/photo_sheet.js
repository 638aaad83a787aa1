/** The photograph over the model while one looks from its camera, as opaque as a slider says. */

import { store } from "../../net/store.js";
import { slider } from "../../ui/controls.js";
import { element } from "../../ui/dom.js";
import { pictureAddress } from "./model_parts.js";

const LOOK_MS = 100;
const NEAR = 0.005; // of the sheet's distance: from farther off, picture and model are displaced by more than 0.3 deg
const AFTER_A_FLIGHT = 0.5;

/**
 * @typedef {import("../../protocol.d.ts").Sheet} Sheet
 */

/**
 * @param {Pick<Sheet, "columns" | "corners">} sheet
 * @returns {{positions: Float32Array, uv: Float32Array, faces: Uint32Array}} its triangles, without those at no ray
 */
export const sheetArrays = ({ columns, corners }) => {
  const rows = corners.length / columns;
  const positions = new Float32Array(corners.flatMap((corner) => corner ?? [0, 0, 0]));
  const uv = new Float32Array(corners.flatMap((_, k) => [(k % columns) / (columns - 1), Math.floor(k / columns) / (rows - 1)]));
  const faces = [];
  for (let k = 0; k + columns < corners.length; k += 1) {
    if (k % columns === columns - 1) continue;
    for (const face of [[k, k + columns, k + 1], [k + 1, k + columns, k + columns + 1]]) {
      if (face.every((corner) => corners[corner])) faces.push(...face);
    }
  }
  return { positions, uv, faces: new Uint32Array(faces) };
};

/** @param {number[]} a @param {number[]} b */
const distance = (a, b) => Math.hypot(...a.map((value, k) => value - b[k]));

/**
 * @param {import("./model_loader.js").ModelLoader} loader
 * @returns {HTMLElement} the slider, over the 3-D view
 */
export const mountPhotoSheet = ({ surface }) => {
  let opacity = 0;
  /** @type {{sheet: Sheet, arrays: ReturnType<typeof sheetArrays>} | null} the triangles of the sheet that was seen last */
  let known = null;
  /** @type {{address: string, bitmap: ImageBitmap | null}} */
  let picture = { address: "", bitmap: null };
  const share = slider({
    label: "Photograph",
    least: 0,
    most: 1,
    step: 0.01,
    text: (value) => `${Math.round(100 * value)} %`,
    changed: (value) => set(value),
  });
  const bar = element("div", { class: "photo-sheet", role: "group", "aria-label": "Opacity of the photograph", hidden: true }, share.row);

  const load = (/** @type {string} */ address) => {
    /** @type {typeof picture} */
    const wanted = { address, bitmap: null };
    picture.bitmap?.close();
    picture = wanted;
    surface.bitmapOf(address).then(
      (bitmap) => {
        if (picture !== wanted) return bitmap.close();
        wanted.bitmap = bitmap;
        return look();
      },
      () => picture === wanted && (picture = { address: "", bitmap: null }), // the next look tries again
    );
  };

  const look = () => {
    const sheet = store.get("model")?.sheet;
    const eye = sheet ? surface.eye : null;
    const photo = sheet ? store.photo(sheet.photo) : null;
    const there = Boolean(eye && sheet && photo && distance(eye, sheet.centre) <= NEAR * sheet.distance);
    bar.hidden = !there;
    if (!sheet || !photo || !there || opacity === 0) {
      surface.endSheet();
      return;
    }
    if (!known || known.sheet !== sheet) known = { sheet, arrays: sheetArrays(sheet) };
    const address = pictureAddress(photo);
    if (picture.address !== address) {
      surface.endSheet();
      load(address);
    } else if (picture.bitmap) surface.drawSheet(picture.bitmap, known.arrays, opacity);
  };

  const set = (/** @type {number} */ value) => {
    opacity = value;
    share.show(value);
    look();
  };

  store.onEvent("flown", () => opacity === 0 && set(AFTER_A_FLIGHT));
  store.watch(["model", "photos"], look);
  setInterval(look, LOOK_MS);
  set(0);
  return bar;
};
