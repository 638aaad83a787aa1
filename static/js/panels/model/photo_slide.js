/** The photograph on the surface of the scan as a camera that moves would throw it: where each vertex lies in it. No DOM here. */

/** @typedef {{width: number, height: number, fx: number, fy: number, cx: number, cy: number, distortion?: number[]}} Camera */

const NEAR_M = 1e-3;
const WIDEST = 2; // of the tangent of half the field of view: beyond, terms of distortion would fold the picture

/**
 * Project the vertices of a surface into a photograph. What is hidden behind a nearer surface is coloured as well: while the
 * pose is still wrong, nothing is known of what the camera sees.
 * @param {{positions: Float32Array, faces: Uint32Array}} surface scanner frame, m
 * @param {Camera} camera of the photograph, px; (0, 0) is the centre of its first pixel. Source: OpenCV's model with k1, k2,
 *   p1, p2, k3; further terms are left out.
 * @param {number[][]} pose camera_from_scanner, three rows of four
 * @returns {{uv: Float32Array, faces: Uint32Array}} texture coordinates of all vertices, and the faces inside of the picture
 */
export const thrownOnto = ({ positions, faces }, camera, pose) => {
  const { width, height, fx, fy, cx, cy } = camera;
  const [k1 = 0, k2 = 0, p1 = 0, p2 = 0, k3 = 0] = camera.distortion ?? [];
  const [[a, b, c, d], [e, f, g, h], [i, j, k, l]] = pose;
  const count = positions.length / 3;
  const uv = new Float32Array(2 * count);
  const inside = new Uint8Array(count);
  const widest = WIDEST * Math.hypot(width / fx, height / fy);
  for (let n = 0; n < count; n += 1) {
    const [x, y, z] = [positions[3 * n], positions[3 * n + 1], positions[3 * n + 2]];
    const depth = i * x + j * y + k * z + l;
    if (!(depth > NEAR_M)) continue;
    const [s, t] = [(a * x + b * y + c * z + d) / depth, (e * x + f * y + g * z + h) / depth];
    const r = s * s + t * t;
    if (!(r < widest * widest)) continue;
    const radial = 1 + r * (k1 + r * (k2 + r * k3));
    const u = fx * (s * radial + 2 * p1 * s * t + p2 * (r + 2 * s * s)) + cx;
    const v = fy * (t * radial + p1 * (r + 2 * t * t) + 2 * p2 * s * t) + cy;
    uv[2 * n] = (u + 0.5) / width;
    uv[2 * n + 1] = (v + 0.5) / height;
    inside[n] = u >= -0.5 && v >= -0.5 && u <= width - 0.5 && v <= height - 0.5 ? 1 : 0;
  }
  const kept = new Uint32Array(faces.length);
  let length = 0;
  for (let n = 0; n < faces.length; n += 3) {
    if (!(inside[faces[n]] && inside[faces[n + 1]] && inside[faces[n + 2]])) continue;
    kept.set(faces.subarray(n, n + 3), length);
    length += 3;
  }
  return { uv, faces: kept.subarray(0, length) };
};
