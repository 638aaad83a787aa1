/** How large and how opaque the marks of matches are in viser's scene. */

const MARKS = ["/matches/points", "/highlight/halo", "/highlight/point"];

/** Marks keep between these sizes on the screen, and fade where they would cover the surface or crowd it. */
const SIZE_ON_SCREEN = "gl_PointSize = clamp(scale / -world_pos.z, 4.0 * lrPixels, 16.0 * lrPixels);" +
  "lrAlpha = 1.0 - 0.75 * smoothstep(12.0 * lrPixels, 40.0 * lrPixels, scale / -world_pos.z)" +
  " - 0.35 * (1.0 - smoothstep(1.0 * lrPixels, 4.0 * lrPixels, scale / -world_pos.z));";

/**
 * @param {any} node of viser's scene (three.js), or undefined
 * @returns {any} the first mesh or cloud of points of a node, or null
 */
export const meshIn = (node) => {
  let found = null;
  node?.traverse((/** @type {any} */ each) => {
    if (each.isMesh || each.isPoints) found ??= each;
  });
  return found;
};

/**
 * Let new marks fade with their distance.
 * @param {any} viewer what viser's page exposes
 * @param {number} pixels of the screen in one of CSS
 * @returns {boolean} whether there were any
 */
export const fadeNewMarks = (viewer, pixels) => {
  let found = false;
  for (const name of MARKS) {
    const material = meshIn(viewer.nodeRefFromName?.[name])?.material;
    if (!material?.vertexShader || material.userData.faded) continue;
    found = material.userData.faded = true;
    material.vertexShader = material.vertexShader
      .replace("void main()", `varying float lrAlpha;\nconst float lrPixels = ${pixels.toFixed(3)};\nvoid main()`)
      .replace(/gl_PointSize = [^;]*;/, SIZE_ON_SCREEN);
    material.fragmentShader = material.fragmentShader
      .replace("void main()", "varying float lrAlpha;\nvoid main()")
      .replace("vec4(col, 1.0)", "vec4(col, lrAlpha)");
    material.transparent = true;
    material.needsUpdate = true;
  }
  return found;
};
