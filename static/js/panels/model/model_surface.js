/**
 * The model's surface in viser's scene. viser can only replace a mesh together with its texture, and sends both to every
 * client; the page fetches them itself and puts them into the node that viser keeps for them. This uses the objects that
 * viser's page exposes for tests; the version of viser is fixed, and tests/e2e/test_model.py notices if they change.
 */

import { fadeNewMarks, meshIn } from "./model_marks.js";
import { AS_IT_IS, decoded, discard, geometryOf, mix, pictured, unmix } from "./model_nodes.js";
import { cellsInView, facesBeside, firstPlace, placeUnder } from "./model_view.js";

const NODE = "/model";
const LAYER = "photo layer";
const BLOCK = "block";
const SLIDE = "sliding photograph";
const BELOW_SLIDE = 0.3; // brightness
const SHEET = "photograph before its camera";
const OVER_ALL = 1000; // order of drawing
const BOTH_SIDES = 2; // of three.js: DoubleSide
const [REPEAT, TRILINEAR] = [1000, 1008]; // of three.js: RepeatWrapping, LinearMipmapLinearFilter
const CLICK = "ScenePointerMessage"; // of viser
const PICKED_PX = 0.5; // standard deviation of a click along each axis

/**
 * @typedef {import("./model_nodes.js").Node} Node
 * @typedef {import("./model_nodes.js").Inner} Inner
 * @typedef {import("./model_nodes.js").Triangles} Triangles
 * @typedef {import("./model_parts.js").MeshArrays} MeshArrays
 */

/** The window of viser's page, with what it exposes. */
export class ModelSurface {
  #frame;
  /** @type {Node} null: nothing is drawn */
  #mesh = null;
  /** @type {{arrays: MeshArrays, faces: Uint32Array} | null} what is drawn of the surface */
  #own = null;
  /** @type {Node} */
  #layer = null;
  /** @type {{node: Node, bitmap: ImageBitmap, arrays: MeshArrays} | null} */
  #slide = null;
  /** @type {{node: Node, arrays: MeshArrays}[]} */
  #blocks = [];
  /** @type {{node: Node, bitmap: ImageBitmap, arrays: Triangles} | null} */
  #sheet = null;
  /** @type {{map: any, share: {value: number}} | null} the texture that is mixed into that of the surface */
  #second = null;
  #share = 0.5;
  /** @type {((ndc: number[]) => void) | null} takes clicks in place of the workbench */
  #takesClicks = null;
  /** @type {((message: any) => void) | null} */
  #send = null;

  /** @param {HTMLIFrameElement} frame */
  constructor(frame) {
    this.#frame = frame;
  }

  /** @returns {boolean} whether viser's page shows its scene */
  get ready() {
    return this.#find() !== null;
  }

  /** @returns {boolean} whether what was drawn last is still there: viser makes new objects when it reconnects */
  get intact() {
    return this.#drawn !== null;
  }

  /** @returns {Node} what was drawn last, or null */
  get #drawn() {
    return this.#mesh !== null && this.#find() === this.#mesh ? this.#mesh : null;
  }

  /**
   * Draw a mesh with a texture, in place of the last ones.
   * @param {MeshArrays} arrays
   * @param {Blob} picture
   * @param {() => boolean} still whether it is still wanted once the picture is decoded
   * @param {Blob | null} second another texture, which is mixed in as `share` says
   * @returns {Promise<boolean>} whether it was drawn
   */
  async draw(arrays, picture, still, second = null) {
    const inner = this.#inner;
    const [bitmap, other] = await Promise.all([
      inner.createImageBitmap(picture, AS_IT_IS),
      second && inner.createImageBitmap(second, AS_IT_IS),
    ]);
    const mesh = this.#find();
    if (!mesh || !still()) return false;
    this.#dropLayer();
    if (this.#own?.arrays !== arrays || this.#mesh !== mesh) this.#dropBlocks();
    this.#setTexture(mesh, bitmap);
    this.#setSecond(mesh, other);
    if (this.#own?.arrays !== arrays || this.#mesh !== mesh) this.#setGeometry(mesh, arrays, inner);
    this.#mesh = mesh;
    this.#viewer.requestRender();
    await this.#nextFrames(2);
    return true;
  }

  /**
   * Draw the photograph over the surface, where the camera sees it.
   * @param {{arrays: MeshArrays, blob: Blob} | null} found null: the camera sees nothing
   * @param {() => boolean} still whether it is still wanted once the picture is decoded
   * @returns {Promise<boolean>} whether it was drawn
   */
  async drawLayer(found, still) {
    const inner = this.#inner;
    const bitmap = found && (await decoded(inner, found.blob));
    const mesh = this.#find();
    if (!mesh || mesh !== this.#mesh || !still()) return false;
    this.#dropLayer();
    this.setBlocks([]); // it lies on the surface of the whole scan
    if (!found || !bitmap) return true;
    // in front of the surface that it lies on
    const material = pictured(mesh, bitmap, { polygonOffset: true, polygonOffsetFactor: -1, polygonOffsetUnits: -4 });
    material.map.wrapS = REPEAT; // triangles across the seam of a panorama
    material.map.minFilter = TRILINEAR;
    material.map.generateMipmaps = true;
    const layer = new mesh.constructor(geometryOf(mesh.geometry, found.arrays, inner), material);
    layer.name = LAYER;
    layer.raycast = () => {}; // clicks are the surface's
    mesh.add(layer);
    this.#layer = layer;
    this.#viewer.requestRender();
    await this.#nextFrames(2);
    return true;
  }

  /** @param {number} share of the second texture, 0 to 1 */
  set share(share) {
    this.#share = share;
    if (!this.#second || this.#second.share.value === share) return;
    this.#second.share.value = share;
    this.#viewer?.requestRender();
  }

  /** @returns {string} a text that changes when the camera moves; empty if nothing is drawn */
  get viewpoint() {
    const camera = this.#viewer?.camera;
    return this.intact && camera ? [...camera.matrixWorld.elements, ...camera.projectionMatrix.elements].map((n) => n.toFixed(4)).join() : "";
  }

  /** @returns {boolean} whether the photograph's own pixels are drawn */
  get hasLayer() {
    return this.#layer !== null;
  }

  /** @returns {{cells: number[][], shape: number[], vertices: number} | null} what of the scan's grid is in view */
  inView() {
    const { look } = this;
    const arrays = this.#own?.arrays;
    if (!look || !arrays) return null;
    return { cells: cellsInView(arrays, look), shape: arrays.shape, vertices: arrays.positions.length / 3 };
  }

  /** @returns {import("./model_view.js").Look | null} from where one looks; null if nothing is drawn */
  get look() {
    const camera = this.#viewer?.camera;
    if (!camera || !this.intact) return null;
    return {
      world: camera.matrixWorld.elements,
      projectionInverse: camera.projectionMatrixInverse.elements,
      meshInverse: this.#mesh.matrixWorld.clone().invert().elements,
    };
  }

  /** @returns {{positions: Float32Array, faces: Uint32Array}[]} what is drawn of the surface: finer where there are blocks */
  get #surfaces() {
    if (!this.#own) return [];
    const whole = { positions: this.#own.arrays.positions, faces: this.#own.faces };
    return [whole, ...this.#blocks.map(({ arrays }) => arrays)];
  }

  /** @returns {{place: number[], sigma: number} | null} what is under a place of the picture, see `placeUnder` */
  placeUnder(/** @type {number[]} */ ndc) {
    const { look } = this;
    if (!look) return null;
    const { innerWidth, innerHeight } = this.#inner;
    return placeUnder(this.#surfaces, look, ndc, [innerWidth, innerHeight].map((length) => (2 * PICKED_PX) / length));
  }

  /** @returns {number[] | null} where a ray of the scanner meets the surface, m */
  placeOn(/** @type {number[]} */ ray) {
    return firstPlace(this.#surfaces, [0, 0, 0], ray);
  }

  /** @returns {number[] | null} CSS pixels of the frame where a place (x, y, z) is seen; null: it is behind the eye */
  onScreen(/** @type {number[]} */ place) {
    const camera = this.#viewer?.camera;
    if (!camera || !this.intact) return null;
    const at = camera.position.clone().fromArray(place).applyMatrix4(this.#mesh.matrixWorld);
    if (at.clone().applyMatrix4(camera.matrixWorldInverse).z >= 0) return null;
    const { x, y } = at.project(camera);
    const { innerWidth, innerHeight } = this.#inner;
    return [((x + 1) / 2) * innerWidth - 0.5, ((1 - y) / 2) * innerHeight - 0.5];
  }

  /**
   * Clicks go to a function instead of the workbench; those that turn or move the view are none.
   * @param {((ndc: number[]) => void) | null} take called with the place in the picture, -1 to 1; null: the workbench
   */
  takeClicks(take) {
    this.#takesClicks = take;
    this.listenToClicks();
  }

  /** viser's page makes another function that sends whenever it connects. */
  listenToClicks() {
    const viewer = this.#viewer;
    if (!viewer || viewer.sendMessage === this.#send) return;
    const send = viewer.sendMessage;
    /** @param {any} message */
    const sendOthers = (message) => {
      if (message.type !== CLICK || !this.#takesClicks) return send(message);
      const [u, v] = message.screen_pos[0];
      return this.#takesClicks([2 * u - 1, 1 - 2 * v]);
    };
    viewer.sendMessage = this.#send = sendOthers;
  }

  /** Show that a click sets a point, or not. @param {boolean} on */
  set aims(on) {
    const { canvas } = this.#viewer ?? {};
    if (canvas) canvas.style.cursor = on ? "crosshair" : "pointer";
  }

  /**
   * Draw blocks of the surface in place of what the whole surface shows there.
   * @param {{name: string, arrays: MeshArrays}[]} blocks
   */
  setBlocks(blocks) {
    const mesh = this.#drawn;
    const own = this.#own;
    if (!mesh || !own || (blocks.length === 0 && this.#blocks.length === 0)) return;
    this.#dropBlocks();
    const inner = this.#inner;
    for (const { arrays } of blocks) {
      const block = new mesh.constructor(geometryOf(mesh.geometry, arrays, inner), mesh.material); // its texture, too
      block.name = BLOCK;
      mesh.add(block);
      this.#blocks.push({ node: block, arrays });
    }
    this.#setFaces(own, facesBeside(own.arrays, blocks.map(({ name }) => name)));
    this.#viewer.requestRender();
  }

  /** @param {string} address of a picture @returns {Promise<ImageBitmap>} for `slide` */
  async bitmapOf(address) {
    return decoded(this.#inner, await (await fetch(address)).blob());
  }

  /**
   * Throw a photograph onto the surface from a camera that moves, over whatever is drawn there.
   * @param {ImageBitmap} bitmap of this window; the same one as long as it is the same photograph
   * @param {(surface: MeshArrays) => {uv: Float32Array, faces: Uint32Array}} thrown
   */
  slide(bitmap, thrown) {
    const mesh = this.#drawn;
    if (!mesh || !this.#own) return;
    const inner = this.#inner;
    const { arrays } = this.#own;
    const { uv, faces } = thrown(arrays);
    if (this.#slide && (this.#slide.bitmap !== bitmap || this.#slide.arrays !== arrays)) this.endSlide();
    if (!this.#slide) {
      const material = pictured(mesh, bitmap, { polygonOffset: true, polygonOffsetFactor: -2, polygonOffsetUnits: -8 });
      material.color.setScalar(1);
      const node = new mesh.constructor(geometryOf(mesh.geometry, { ...arrays, uv, faces }, inner), material);
      node.name = SLIDE;
      node.raycast = () => {};
      mesh.add(node);
      this.#slide = { node, bitmap, arrays };
    }
    const { geometry } = this.#slide.node;
    geometry.attributes.uv.array.set(uv);
    geometry.attributes.uv.needsUpdate = true;
    geometry.setIndex(new geometry.index.constructor(new inner.Uint32Array(faces), 1));
    // the photograph is where the solver has it: what is below steps back
    if (this.#layer) this.#layer.visible = false;
    mesh.material.color.setScalar(BELOW_SLIDE);
    this.#viewer.requestRender();
  }

  /** Remove the photograph that slides. */
  endSlide() {
    if (!this.#slide) return;
    const { node } = this.#slide;
    node.parent?.material.color.setScalar(1);
    discard(node);
    this.#slide = null;
    if (this.#layer) this.#layer.visible = true;
    this.#viewer?.requestRender();
  }

  /** @returns {number[] | null} where one looks from, m, scanner frame */
  get eye() {
    const camera = this.#viewer?.camera;
    if (!camera || !this.intact) return null;
    return camera.position.clone().setFromMatrixPosition(camera.matrixWorld).applyMatrix4(this.#mesh.matrixWorld.clone().invert()).toArray();
  }

  /**
   * Draw a picture over everything, on a sheet that stands before its camera.
   * @param {ImageBitmap} bitmap of this window; the same one as long as it is the same photograph
   * @param {Triangles} arrays the same ones as long as it stands there
   * @param {number} opacity 0 to 1
   */
  drawSheet(bitmap, arrays, opacity) {
    const mesh = this.#drawn;
    if (!mesh) return;
    const known = this.#sheet;
    if (known && (known.bitmap !== bitmap || known.arrays !== arrays || known.node.parent !== mesh)) this.endSheet();
    if (!this.#sheet) {
      const material = pictured(mesh, bitmap, { transparent: true, depthTest: false, depthWrite: false, side: BOTH_SIDES });
      material.color.setScalar(1);
      const node = new mesh.constructor(geometryOf(mesh.geometry, arrays, this.#inner), material);
      node.name = SHEET;
      node.renderOrder = OVER_ALL;
      node.raycast = () => {};
      mesh.add(node);
      this.#sheet = { node, bitmap, arrays };
    } else if (this.#sheet.node.material.opacity === opacity) return;
    this.#sheet.node.material.opacity = opacity;
    this.#viewer.requestRender();
  }

  /** Remove the sheet. */
  endSheet() {
    if (!this.#sheet) return;
    discard(this.#sheet.node);
    this.#sheet = null;
    this.#viewer?.requestRender();
  }

  /** Show nothing. */
  clear() {
    this.endSlide();
    this.endSheet();
    this.#dropLayer();
    this.#dropBlocks();
    const mesh = this.#find();
    if (mesh && this.#own) mesh.visible = false;
    this.#mesh = null;
    this.#own = null;
    this.#viewer?.requestRender();
  }

  /** Let new marks fade with their distance. */
  fadeMarks() {
    const viewer = this.#viewer;
    if (viewer && fadeNewMarks(viewer, this.#inner.devicePixelRatio)) viewer.requestRender();
  }

  /** @returns {Inner} */
  get #inner() {
    const inner = /** @type {Inner | null} */ (this.#frame.contentWindow);
    if (!inner) throw new Error("The frame of the 3-D view is not in the page: reload the page.");
    return inner;
  }

  /** @returns {any} what viser's page exposes, or null */
  get #viewer() {
    try {
      return this.#inner.__viserMutable ?? null;
    } catch {
      return null; // the frame shows the browser's error page, which is not accessible, or is not there yet
    }
  }

  /** @returns {Node} the mesh that viser keeps for the surface, or null */
  #find() {
    const mesh = meshIn(this.#viewer?.nodeRefFromName?.[NODE]);
    return mesh?.isMesh && mesh.material.map ? mesh : null;
  }

  /** @param {Node} mesh @param {ImageBitmap} bitmap */
  #setTexture(mesh, bitmap) {
    const before = mesh.material.map;
    const map = before.clone();
    map.source = new before.source.constructor(bitmap);
    map.needsUpdate = true;
    const { material } = mesh;
    material.map = map;
    material.color.setRGB(1, 1, 1);
    material.toneMapped = false; // its own colours, as in the photograph
    material.needsUpdate = true;
    before.dispose();
  }

  /** @param {Node} mesh @param {ImageBitmap | null} bitmap */
  #setSecond(mesh, bitmap) {
    const { material } = mesh;
    const before = this.#second;
    this.#second = null;
    if (bitmap) {
      const map = material.map.clone();
      map.source = new material.map.source.constructor(bitmap);
      map.needsUpdate = true;
      const second = { map, share: { value: this.#share } };
      this.#second = second;
      mix(material, second);
    } else if (before) unmix(material);
    material.needsUpdate = true;
    before?.map.dispose();
  }

  /** @param {Node} mesh @param {MeshArrays} arrays @param {Inner} inner */
  #setGeometry(mesh, arrays, inner) {
    const before = mesh.geometry;
    const geometry = geometryOf(before, arrays, inner);
    mesh.geometry = geometry;
    mesh.visible = true;
    this.#own = { arrays, faces: arrays.faces };
    before.dispose();
  }

  /** @param {{faces: Uint32Array}} own @param {Uint32Array} faces */
  #setFaces(own, faces) {
    own.faces = faces;
    const { geometry } = this.#mesh;
    const { index } = geometry;
    geometry.setIndex(new index.constructor(new (this.#inner.Uint32Array)(faces), 1));
  }

  #dropBlocks() {
    if (!this.#blocks.length) return;
    for (const { node } of this.#blocks) {
      node.removeFromParent();
      node.geometry.dispose();
    }
    this.#blocks = [];
    if (this.intact && this.#own) this.#setFaces(this.#own, this.#own.arrays.faces);
  }

  #dropLayer() {
    if (!this.#layer) return;
    const { source } = this.#layer.material.map;
    discard(this.#layer);
    source.data.close();
    this.#layer = null;
  }

  /** @param {number} count @returns {Promise<void>} */
  #nextFrames(count) {
    const inner = this.#inner;
    return new Promise((resolve) => {
      /** @param {number} left */
      const step = (left) => (left ? inner.requestAnimationFrame(() => step(left - 1)) : resolve());
      step(count);
    });
  }
}
