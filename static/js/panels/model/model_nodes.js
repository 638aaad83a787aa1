/** What the page puts into viser's scene: geometries, materials with pictures, and two textures that are mixed. */

import { largestTexture } from "./software_drawing.js";

/** Two textures are mixed as they are seen, in encoded values: halfway between black and white is the middle gray. */
const MIXED = "#include <map_fragment>\n" +
  "vec3 lrOther = diffuse * texture2D(lrSecond, vMapUv).rgb;\n" +
  "diffuseColor.rgb = pow(mix(pow(diffuseColor.rgb, vec3(1.0 / 2.2)), pow(lrOther, vec3(1.0 / 2.2)), lrShare), vec3(2.2));";

/**
 * @typedef {any} Node an object of viser's scene (three.js): the page has no types of it
 * @typedef {Window & typeof globalThis & {__viserMutable?: any}} Inner window of viser's page, with what it exposes and its
 *   own types of arrays
 * @typedef {{positions: Float32Array, uv: Float32Array, faces: Uint32Array}} Triangles
 */

/**
 * Arrays of another window are not recognised by the library inside the frame: they are copied into its own.
 * @param {any} like geometry of three.js
 * @param {Triangles} arrays
 * @param {Inner} inner
 * @returns {any}
 */
export const geometryOf = (like, arrays, inner) => {
  const Attribute = like.attributes.position.constructor;
  const geometry = new like.constructor();
  geometry.setAttribute("position", new Attribute(new inner.Float32Array(arrays.positions), 3));
  geometry.setAttribute("uv", new Attribute(new inner.Float32Array(arrays.uv), 2));
  geometry.setIndex(new Attribute(new inner.Uint32Array(arrays.faces), 1));
  geometry.computeBoundingSphere();
  return geometry;
};

/** @type {ImageBitmapOptions} */
export const AS_IT_IS = { premultiplyAlpha: "none", colorSpaceConversion: "none" };

/**
 * @param {Node} mesh
 * @param {ImageBitmap} bitmap
 * @param {object} look properties of the material
 * @returns {any} the mesh's material with another picture
 */
export const pictured = (mesh, bitmap, look) => {
  const material = mesh.material.clone();
  material.map = mesh.material.map.clone();
  material.map.source = new mesh.material.map.source.constructor(bitmap);
  material.map.needsUpdate = true;
  return Object.assign(material, look);
};

/** @param {Node} node removed, with all of its own */
export const discard = (node) => {
  node.removeFromParent();
  node.geometry.dispose();
  node.material.map.dispose();
  node.material.dispose();
};

/**
 * @param {Inner} inner
 * @param {Blob} blob
 * @returns {Promise<ImageBitmap>} the picture, reduced to what the graphics card takes
 */
export const decoded = async (inner, blob) => {
  const whole = await inner.createImageBitmap(blob, AS_IT_IS);
  const longest = Math.max(whole.width, whole.height);
  const most = largestTexture();
  if (longest <= most) return whole;
  const [width, height] = [whole.width, whole.height].map((n) => Math.max(1, Math.floor((n * most) / longest)));
  const small = await inner.createImageBitmap(
    whole,
    { ...AS_IT_IS, resizeWidth: width, resizeHeight: height, resizeQuality: "high" },
  );
  whole.close();
  return small;
};

/**
 * Mix another texture into that of a material.
 * @param {any} material of three.js
 * @param {{map: any, share: {value: number}}} second
 */
export const mix = (material, second) => {
  /** @param {any} shader */
  material.onBeforeCompile = (shader) => {
    shader.uniforms.lrSecond = { value: second.map };
    shader.uniforms.lrShare = second.share;
    shader.fragmentShader = shader.fragmentShader
      .replace("void main()", "uniform sampler2D lrSecond;\nuniform float lrShare;\nvoid main()")
      .replace("#include <map_fragment>", MIXED);
  };
  material.customProgramCacheKey = () => "two textures";
};

/** Show the own texture of a material alone. @param {any} material of three.js */
export const unmix = (material) => {
  delete material.onBeforeCompile; // its class's, which does nothing
  delete material.customProgramCacheKey;
};
