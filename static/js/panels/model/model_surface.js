/**
 * The model's surface in viser's scene. viser can only replace a mesh together with its texture, and sends both to every
 * client; the page fetches them itself and puts them into the node that viser keeps for them. This uses the objects that
 * viser's page exposes for tests; the version of viser is fixed, and tests/e2e/test_model.py notices if they change.
 */

import { fadeNewMarks, meshIn } from "./model_marks.js";
import { cellsInView, facesBeside, firstPlace, placeUnder } from "./model_view.js";
import { largestTexture } from "./software_drawing.js";

const NODE = "/model";
const LAYER = "photo layer";
const BLOCK = "block";
const SLIDE = "sliding photograph";
const BELOW_SLIDE = 0.3; // brightness
const SHEET = "photograph before its camera";
/** Two textures are mixed as they are seen, in encoded values: halfway between black and white is the middle gray. */
const MIXED = "#include <map_fragment>\n" +
  "vec3 lrOther = diffuse * texture2D(lrSecond, vMapUv).rgb;\n" +
  "diffuseColor.rgb = pow(mix(pow(diffuseColor.rgb, vec3(1.0 / 2.2)), pow(lrOther, vec3(1.0 / 2.2)), lrShare), vec3(2.2));";
const OVER_ALL = 1000; // order of drawing
const BOTH_SIDES = 2; // of three.js: DoubleSide
const [REPEAT, TRILINEAR] = [1000, 1008]; // of three.js: RepeatWrapping, LinearMipmapLinearFilter
const CLICK = "ScenePointerMessage"; // of viser
const PICKED_PX = 0.5; // standard deviation of a click along each axis

/** Arrays of another window are not recognised by the library inside the frame: they are copied into its own. */
const geometryOf = (like, arrays, inner) => {
  const Attribute = like.attributes.position.constructor;
  const geometry = new like.constructor();
  geometry.setAttribute("position", new Attribute(new inner.Float32Array(arrays.positions), 3));
  geometry.setAttribute("uv", new Attribute(new inner.Float32Array(arrays.uv), 2));
  geometry.setIndex(new Attribute(new inner.Uint32Array(arrays.faces), 1));
  geometry.computeBoundingSphere();
  return geometry;
};

/** @type {ImageBitmapOptions} */
const AS_IT_IS = { premultiplyAlpha: "none", colorSpaceConversion: "none" };

/** @returns {Promise<ImageBitmap>} the picture, reduced to what the graphics card takes */
const decoded = async (inner, blob) => {
  const whole = await inner.createImageBitmap(blob, AS_IT_IS);
  const longest = Math.max(whole.width, whole.height);
  const most = largestTexture();
  if (longest <= most) return whole;
  const [width, height] = [whole.width, whole.height].map((n) => Math.max(1, Math.floor((n * most) / longest)));
  const sizes = { resizeWidth: width, resizeHeight: height, resizeQuality: "high" };
  const small = await inner.createImageBitmap(whole, { ...AS_IT_IS, ...sizes });
  whole.close();
  return small;
};

/** The window of viser's page, with what it exposes. */
export class ModelSurface {
  #frame;
  #mesh = null;
  #own = null;
  #layer = null;
  #slide = null;
  #blocks = [];
  #sheet = null;
  /** @type {{map: any, share: {value: number}} | null} the texture that is mixed into that of the surface */
  #second = null;
  #share = 0.5;
  /** @type {((ndc: number[]) => void) | null} takes clicks in place of the workbench */
  #takesClicks = null;
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
    return this.#mesh !== null && this.#find() === this.#mesh;
  }

  /**
   * Draw a mesh with a texture, in place of the last ones.
   * @param {import("./model_parts.js").MeshArrays} arrays
   * @param {Blob} picture
   * @param {() => boolean} still whether it is still wanted once the picture is decoded
   * @param {Blob | null} second another texture, which is mixed in as `share` says
   * @returns {Promise<boolean>} whether it was drawn
   */
  async draw(arrays, picture, still, second = null) {
    const inner = this.#frame.contentWindow;
    const [bitmap, other] = await Promise.all([picture, second].map((blob) => blob && inner.createImageBitmap(blob, AS_IT_IS)));
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
   * @param {{arrays: import("./model_parts.js").MeshArrays, blob: Blob} | null} found null: the camera sees nothing
   * @param {() => boolean} still whether it is still wanted once the picture is decoded
   * @returns {Promise<boolean>} whether it was drawn
   */
  async drawLayer(found, still) {
    const inner = this.#frame.contentWindow;
    const bitmap = found && (await decoded(inner, found.blob));
    const mesh = this.#find();
    if (!mesh || mesh !== this.#mesh || !still()) return false;
    this.#dropLayer();
    this.setBlocks([]); // it lies on the surface of the whole scan
    if (!found) return true;
    const material = mesh.material.clone();
    material.map = mesh.material.map.clone();
    material.map.source = new mesh.material.map.source.constructor(bitmap);
    material.map.wrapS = REPEAT; // triangles across the seam of a panorama
    material.map.minFilter = TRILINEAR;
    material.map.generateMipmaps = true;
    material.map.needsUpdate = true;
    material.polygonOffset = true; // in front of the surface that it lies on
    material.polygonOffsetFactor = -1;
    material.polygonOffsetUnits = -4;
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
  placeUnder(ndc) {
    const { look } = this;
    const { innerWidth, innerHeight } = this.#frame.contentWindow;
    return look && placeUnder(this.#surfaces, look, ndc, [innerWidth, innerHeight].map((length) => (2 * PICKED_PX) / length));
  }

  /** @returns {number[] | null} where a ray of the scanner meets the surface, m */
  placeOn(ray) {
    return firstPlace(this.#surfaces, [0, 0, 0], ray);
  }

  /** @returns {number[] | null} CSS pixels of the frame where a place (x, y, z) is seen; null: it is behind the eye */
  onScreen(place) {
    const camera = this.#viewer?.camera;
    if (!camera || !this.intact) return null;
    const at = camera.position.clone().fromArray(place).applyMatrix4(this.#mesh.matrixWorld);
    if (at.clone().applyMatrix4(camera.matrixWorldInverse).z >= 0) return null;
    const { x, y } = at.project(camera);
    const { innerWidth, innerHeight } = this.#frame.contentWindow;
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
    this.#send = (message) => {
      if (message.type !== CLICK || !this.#takesClicks) return send(message);
      const [u, v] = message.screen_pos[0];
      return this.#takesClicks([2 * u - 1, 1 - 2 * v]);
    };
    viewer.sendMessage = this.#send;
  }

  /** Show that a click sets a point, or not. */
  set aims(on) {
    const { canvas } = this.#viewer ?? {};
    if (canvas) canvas.style.cursor = on ? "crosshair" : "pointer";
  }

  /**
   * Draw blocks of the surface in place of what the whole surface shows there.
   * @param {{name: string, arrays: import("./model_parts.js").MeshArrays}[]} blocks
   */
  setBlocks(blocks) {
    if (!this.intact || (blocks.length === 0 && this.#blocks.length === 0)) return;
    this.#dropBlocks();
    const inner = this.#frame.contentWindow;
    const mesh = this.#mesh;
    for (const { arrays } of blocks) {
      const block = new mesh.constructor(geometryOf(mesh.geometry, arrays, inner), mesh.material); // its texture, too
      block.name = BLOCK;
      mesh.add(block);
      this.#blocks.push({ node: block, arrays });
    }
    this.#setFaces(facesBeside(this.#own.arrays, blocks.map(({ name }) => name)));
    this.#viewer.requestRender();
  }

  /** @param {string} address of a picture @returns {Promise<ImageBitmap>} for `slide` */
  async bitmapOf(address) {
    const inner = this.#frame.contentWindow;
    return decoded(inner, await (await fetch(address)).blob());
  }

  /**
   * Throw a photograph onto the surface from a camera that moves, over whatever is drawn there.
   * @param {ImageBitmap} bitmap of this window; the same one as long as it is the same photograph
   * @param {(surface: import("./model_parts.js").MeshArrays) => {uv: Float32Array, faces: Uint32Array}} thrown
   */
  slide(bitmap, thrown) {
    if (!this.intact || !this.#own) return;
    const inner = this.#inner;
    const mesh = this.#mesh;
    const { arrays } = this.#own;
    const { uv, faces } = thrown(arrays);
    if (this.#slide && (this.#slide.bitmap !== bitmap || this.#slide.arrays !== arrays)) this.endSlide();
    if (!this.#slide) {
      const material = mesh.material.clone();
      material.map = mesh.material.map.clone();
      material.map.source = new mesh.material.map.source.constructor(bitmap);
      material.map.needsUpdate = true;
      material.color.setScalar(1);
      material.polygonOffset = true;
      material.polygonOffsetFactor = -2;
      material.polygonOffsetUnits = -8;
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
    node.removeFromParent();
    node.geometry.dispose();
    node.material.map.dispose();
    node.material.dispose();
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
   * @param {{positions: Float32Array, uv: Float32Array, faces: Uint32Array}} arrays the same ones as long as it stands there
   * @param {number} opacity 0 to 1
   */
  drawSheet(bitmap, arrays, opacity) {
    if (!this.intact) return;
    const known = this.#sheet;
    if (known && (known.bitmap !== bitmap || known.arrays !== arrays || known.node.parent !== this.#mesh)) this.endSheet();
    if (!this.#sheet) {
      const mesh = this.#mesh;
      const material = mesh.material.clone();
      material.map = mesh.material.map.clone();
      material.map.source = new mesh.material.map.source.constructor(bitmap);
      material.map.needsUpdate = true;
      material.color.setScalar(1);
      Object.assign(material, { transparent: true, depthTest: false, depthWrite: false, side: BOTH_SIDES });
      const node = new mesh.constructor(geometryOf(mesh.geometry, arrays, this.#frame.contentWindow), material);
      node.name = SHEET;
      node.renderOrder = OVER_ALL;
      node.raycast = () => {};
      mesh.add(node);
      this.#sheet = { node, bitmap, arrays };
    } else if (known.node.material.opacity === opacity) return;
    this.#sheet.node.material.opacity = opacity;
    this.#viewer.requestRender();
  }

  /** Remove the sheet. */
  endSheet() {
    if (!this.#sheet) return;
    const { node } = this.#sheet;
    node.removeFromParent();
    node.geometry.dispose();
    node.material.map.dispose();
    node.material.dispose();
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
    if (viewer && fadeNewMarks(viewer, this.#frame.contentWindow.devicePixelRatio)) viewer.requestRender();
  }

  /** @returns {any} the window of viser's page, with what it exposes and its own types of arrays */
  get #inner() {
    return this.#frame.contentWindow;
  }

  /** @returns {any} what viser's page exposes, or null */
  get #viewer() {
    try {
      return this.#inner?.__viserMutable ?? null;
    } catch {
      return null; // the frame shows the browser's error page, which is not accessible
    }
  }

  #find() {
    const mesh = meshIn(this.#viewer?.nodeRefFromName?.[NODE]);
    return mesh?.isMesh && mesh.material.map ? mesh : null;
  }

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
      material.onBeforeCompile = (shader) => {
        shader.uniforms.lrSecond = { value: second.map };
        shader.uniforms.lrShare = second.share;
        shader.fragmentShader = shader.fragmentShader
          .replace("void main()", "uniform sampler2D lrSecond;\nuniform float lrShare;\nvoid main()")
          .replace("#include <map_fragment>", MIXED);
      };
      material.customProgramCacheKey = () => "two textures";
    } else if (before) {
      delete material.onBeforeCompile; // its class's, which does nothing
      delete material.customProgramCacheKey;
    }
    material.needsUpdate = true;
    before?.map.dispose();
  }

  #setGeometry(mesh, arrays, inner) {
    const before = mesh.geometry;
    const geometry = geometryOf(before, arrays, inner);
    mesh.geometry = geometry;
    mesh.visible = true;
    this.#own = { arrays, faces: arrays.faces };
    before.dispose();
  }

  #setFaces(faces) {
    this.#own.faces = faces;
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
    if (this.intact && this.#own) this.#setFaces(this.#own.arrays.faces);
  }

  #dropLayer() {
    if (!this.#layer) return;
    this.#layer.removeFromParent();
    this.#layer.geometry.dispose();
    this.#layer.material.map.dispose();
    this.#layer.material.map.source.data.close();
    this.#layer.material.dispose();
    this.#layer = null;
  }

  #nextFrames(count) {
    const inner = this.#frame.contentWindow;
    return new Promise((resolve) => {
      const step = (left) => (left ? inner.requestAnimationFrame(() => step(left - 1)) : resolve());
      step(count);
    });
  }
}
