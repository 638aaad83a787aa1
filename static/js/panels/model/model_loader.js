/** What of the model is loaded and drawn: coarse first, then as fine as wanted; the old texture stays until the new one is. */

import { store } from "../../net/store.js";
import { isRunning } from "../../state/pipeline.js";
import { simplexRun } from "../../state/simplex_run.js";
import { messageOf } from "../../ui/faults.js";
import { whenPanesPainted } from "../../ui/first_pictures.js";
import { blockAddress, layerAddress, meshAddress, ModelParts, pictureAddress, textureAddress } from "./model_parts.js";
import { ModelSurface } from "./model_surface.js";
import { thrownOnto } from "./photo_slide.js";
import { blocksAt } from "./model_view.js";

const LOOK_MS = 250;
const RETRY_MS = 3000;
const COARSEST = "coarse";
/** Accepted photographs beyond which their colours take many seconds to make: the scan's intensity is shown meanwhile. */
const MANY_PHOTOS = 5;
const MIN_CELLS = 1e6; // of a scan whose surface the dense mesh shows only coarsely
const MOVING = ["simplex", "reject_outliers", "thesis"];

/**
 * @typedef {import("../../protocol.d.ts").Model} Model
 * @typedef {import("../../protocol.d.ts").TextureOption} TextureChoice
 */

/** @param {Model} model @returns {TextureChoice[]} the kinds of texture */
export const choicesOf = (model) => model.choices;

/** @param {Model} model @returns {string} the kind of texture that can be shown: the chosen one, or the intensity */
export const usableTexture = (model) =>
  (choicesOf(model).find(({ value }) => value === model.texture)?.usable ? model.texture : "intensity");

/** @param {Model} model @returns {TextureChoice[]} the kinds of texture that can be mixed into the one that is shown */
export const blendable = (model) => choicesOf(model).filter(({ value, usable }) => usable && value !== usableTexture(model));

/**
 * @typedef {import("./model_legend.js").Legend} Legend
 * @typedef {{mesh: string, texture: string, second: string, layer?: {mesh: string, picture: string}}} Stage addresses of
 *   what is drawn
 * @typedef {{state: "empty" | "loading" | "drawn", got: number, total: number, error: string, legend: Legend | null, second: Legend | null,
 *   mixed: boolean, whole: boolean}} ModelState `second`: the legend of the texture that is mixed in; `whole`: as fine as it will be
 */

export class ModelLoader {
  #parts = new ModelParts();
  #surface;
  #software;
  /** @type {Set<(state: ModelState) => void>} */
  #listeners = new Set();
  /** @type {{goal: Stage, abort: AbortController} | null} */
  #running = null;
  /** @type {string | null} */
  #scan = null;
  #retryAt = 0;
  #viewpoint = "";
  #looked = "";
  /** @type {AbortController | null} */
  #closer = null;
  /** @type {Stage | null} */
  #drawn = null;
  /** @type {{address: string, bitmap: ImageBitmap | null} | null} the photograph that slides over the surface */
  #sliding = null;
  /** @type {Map<string, [number, number]>} */
  #meter = new Map();
  /** @type {ModelState} */
  #state = { state: "empty", got: 0, total: 0, error: "", legend: null, second: null, mixed: false, whole: false };
  #blend = "";

  /**
   * @param {HTMLIFrameElement} frame
   * @param {() => boolean} software whether the browser renders without a graphics card
   */
  constructor(frame, software) {
    this.#surface = new ModelSurface(frame);
    this.#software = software;
    simplexRun.onChange(() => this.#slide());
    whenPanesPainted().then(() => {
      store.watch(["scan", "shown", "model", "job"], () => this.#look());
      setInterval(() => this.#look(), LOOK_MS);
      this.#look();
    });
  }

  /** While the simplex runs or is replayed, the photograph lies where its pose throws it. */
  #slide() {
    const frame = simplexRun.current;
    const photo = store.photo(frame?.photo);
    const camera = photo?.camera;
    if (!frame?.camera_from_scanner || !photo || camera?.fx === undefined) {
      this.#surface.endSlide();
      return;
    }
    const picture = this.#slidingPicture(photo);
    if (picture) this.#surface.slide(picture, (surface) => thrownOnto(surface, camera, frame.camera_from_scanner));
  }

  /** @param {import("../../net/store.js").Photo} photo @returns {ImageBitmap | null} null while it is being loaded; it is shown as soon as it is there */
  #slidingPicture(photo) {
    const address = pictureAddress(photo);
    if (this.#sliding?.address === address) return this.#sliding.bitmap;
    /** @type {{address: string, bitmap: ImageBitmap | null}} */
    const sliding = { address, bitmap: null };
    this.#sliding = sliding;
    this.#surface.bitmapOf(address).then(
      (bitmap) => {
        sliding.bitmap = bitmap;
        if (this.#sliding === sliding) this.#slide();
      },
      () => this.#sliding === sliding && (this.#sliding = null), // the next frame tries again
    );
    return null;
  }

  /** @returns {ModelSurface} what is drawn */
  get surface() {
    return this.#surface;
  }

  /** Mix another kind of texture into the one that is chosen. @param {string} kind empty: none */
  blendWith(kind) {
    if (kind === this.#blend) return;
    this.#blend = kind;
    this.#look();
  }

  /** Call `listen(state)` at each change. @param {(state: ModelState) => void} listen */
  onChange(listen) {
    this.#listeners.add(listen);
    listen(this.#state);
  }

  /** Count what another part of the 3-D view has loaded. @param {string} name @param {number} got @param {number} total */
  count(name, got, total) {
    this.#meter.set(name, [got, total]);
    this.#report({});
  }

  /** @param {Partial<ModelState>} change */
  #report(change) {
    let [got, total] = [0, 0];
    for (const [some, all] of this.#meter.values()) [got, total] = [got + some, total + all];
    this.#state = { ...this.#state, got, total, ...change };
    for (const listen of this.#listeners) listen(this.#state);
  }

  /** Begin to load if what is drawn is not what is wanted. */
  #look() {
    this.#surface.fadeMarks();
    const open = store.get("scan");
    const scan = open?.id ?? null;
    if (scan !== this.#scan) this.#reset(scan);
    const model = store.get("model");
    if (!scan || !model || open?.error) return;
    const stages = this.#stages(scan, model);
    const goal = stages[stages.length - 1];
    if (this.#running) {
      if (same(this.#running.goal, goal)) return;
      this.#running.abort.abort();
      this.#running = null;
    }
    if (same(this.#drawn, goal) && this.#surface.intact) {
      this.#lookCloser(scan, model);
      return;
    }
    if (performance.now() < this.#retryAt && this.#state.error) return;
    this.#load(stages, goal);
  }

  /** Once the camera rests, draw finer what it looks at; not below the photograph's own pixels. @param {string} scan @param {Model} model */
  async #lookCloser(scan, model) {
    const { viewpoint } = this.#surface;
    const rests = viewpoint === this.#viewpoint;
    this.#viewpoint = viewpoint;
    if (!rests || viewpoint === this.#looked || model.detail === COARSEST || this.#surface.hasLayer) return;
    this.#looked = viewpoint;
    const seen = this.#surface.inView();
    if (!seen || seen.shape[0] * seen.shape[1] < MIN_CELLS) return;
    const names = blocksAt(seen.cells, seen.shape, seen.vertices, Boolean(store.get("scan")?.strip));
    this.#closer?.abort();
    const abort = new AbortController();
    this.#closer = abort;
    try {
      const options = { signal: abort.signal, progress: () => {} };
      const blocks = await Promise.all(
        names.map(async (name) => ({ name, arrays: await this.#parts.block(blockAddress(scan, name), options) })),
      );
      if (abort.signal.aborted || !same(this.#drawn, this.#stages(scan, model).at(-1) ?? null) || this.#surface.hasLayer) return;
      this.#surface.setBlocks(blocks.flatMap(({ name, arrays }) => (arrays ? [{ name, arrays }] : [])));
    } catch {
      // the whole surface stays; the next movement tries again
    }
  }

  /** @param {string | null} scan id */
  #reset(scan) {
    this.#running?.abort.abort();
    this.#closer?.abort();
    this.#looked = "";
    this.#running = this.#drawn = null;
    this.#scan = scan;
    this.#parts.clear();
    this.#surface.clear();
    this.#report({ state: scan ? "loading" : "empty", error: "", legend: null, second: null, mixed: false, whole: false });
  }

  /** @param {string} scan @param {Model} model @returns {Stage[]} what to draw, one after the other */
  #stages(scan, model) {
    const kind = usableTexture(model);
    const blend = blendable(model).some(({ value }) => value === this.#blend) ? this.#blend : "";
    const job = store.get("job");
    const moves = job && MOVING.includes(job.kind) && isRunning(job) && this.#software();
    const at = (/** @type {string} */ meshDetail, /** @type {string} */ textureDetail, /** @type {string} */ texture = kind) => ({
      mesh: meshAddress(scan, meshDetail),
      texture: textureAddress(store.shown(), texture, model, textureDetail),
      second: blend && textureAddress(store.shown(), blend, model, textureDetail),
    });
    const fine = at(moves ? "coarse" : model.detail, model.detail);
    const many = (store.get("photos") ?? []).filter(({ state }) => state === "accepted").length > MANY_PHOTOS;
    const first = kind === "colour" && many ? "intensity" : kind;
    const stages = this.#drawn || (model.detail === "coarse" && first === kind) ? [fine] : [at("coarse", "coarse", first), fine];
    const photo = store.shown();
    if (kind !== "colour" || blend || !photo || !model.accepted || !model.z_buffer || moves || model.detail === "coarse") {
      return stages;
    }
    return [...stages, { ...fine, layer: layerAddress(photo, model, model.detail) }];
  }

  /** @param {Stage[]} stages @param {Stage} goal the last of them */
  async #load(stages, goal) {
    const abort = new AbortController();
    const run = { goal, abort };
    this.#running = run;
    const still = () => this.#running === run;
    try {
      this.#report({ whole: false });
      for (const { mesh, texture, second, layer } of stages) {
        /** @param {string} name @returns {import("./model_parts.js").Download} */
        const options = (name) => ({
          signal: abort.signal,
          progress: (got, total) => {
            if (still()) this.count(name, got, total);
          },
        });
        const [arrays, { blob, legend }, other] = await Promise.all([
          this.#parts.mesh(mesh, options("mesh")),
          this.#parts.texture(texture, options("texture")),
          second ? this.#parts.texture(second, options("second texture")) : null,
        ]);
        await this.#untilReady(still);
        if (layer) {
          const progress = (/** @type {string} */ name) => options(name).progress;
          const found = await this.#parts.layer(layer, { signal: abort.signal, progress });
          if (!still() || !(await this.#surface.drawLayer(found, still))) return;
          this.#drawn = { mesh, texture, second, layer };
          this.#meter.clear();
          this.#report({});
          continue;
        }
        if (!still() || !(await this.#surface.draw(arrays, blob, still, other?.blob))) return;
        this.#looked = "";
        this.#drawn = { mesh, texture, second };
        this.#meter.clear();
        this.#report({ state: "drawn", error: "", legend, second: other?.legend ?? null, mixed: Boolean(other) });
      }
      this.#report({ whole: true });
    } catch (error) {
      if (!still()) return;
      this.#retryAt = performance.now() + RETRY_MS;
      this.#meter.clear();
      this.#report({ error: messageOf(error) });
    } finally {
      if (still()) this.#running = null;
    }
  }

  /** @param {() => boolean} still */
  async #untilReady(still) {
    while (still() && !this.#surface.ready) await new Promise((resolve) => setTimeout(resolve, 50));
  }
}

/** @param {Stage | null} a @param {Stage | null} b */
const same = (a, b) =>
  a !== null && b !== null && a.layer?.mesh === b.layer?.mesh && a.mesh === b.mesh && a.texture === b.texture && a.second === b.second;
