/** What of the surface somebody sees in the 3-D view: places under pixels, and which blocks show them finer. */

/** Rays that are followed from the camera: across and down, -1 to 1 of the picture. */
const AIMS = [0, -0.4, 0.4, -0.8, 0.8];
const AIMED = AIMS.flatMap((v) => AIMS.map((u) => [u, v])).sort((a, b) => Math.hypot(...a) - Math.hypot(...b));
const MIN_HITS = 3;
const FINEST_LEVEL = 8;
const BLOCK_VERTICES = 37500; // at most, as app/workbench/state/model_parts.py makes them
const WORTHWHILE = 4; // times as many vertices in the same place as the whole surface has
const MIN_CELLS = 2;

/** @typedef {import("./model_parts.js").MeshArrays} MeshArrays */

/**
 * @param {ArrayLike<number>} m matrix of three.js, 16 numbers, column by column
 * @param {readonly number[]} place (x, y, z)
 * @returns {number[]} the place moved by it
 */
const applied = (m, [x, y, z]) => {
  const w = m[3] * x + m[7] * y + m[11] * z + m[15];
  return [0, 1, 2].map((k) => (m[k] * x + m[4 + k] * y + m[8 + k] * z + m[12 + k]) / w);
};

/** @param {readonly number[]} a @param {readonly number[]} b */
const less = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];

/**
 * @typedef {{world: ArrayLike<number>, projectionInverse: ArrayLike<number>, meshInverse: ArrayLike<number>}} Look
 *   matrices of three.js
 */

/**
 * @param {Look} look
 * @returns {(ndc: number[]) => {from: number[], along: number[]}} the ray through a place of the picture, -1 to 1
 */
const raysOf = ({ world, projectionInverse, meshInverse }) => {
  const at = (/** @type {number[]} */ ndc) => applied(meshInverse, applied(world, applied(projectionInverse, ndc)));
  return ([u, v]) => {
    const from = at([u, v, -1]);
    return { from, along: less(at([u, v, 0.5]), from) };
  };
};

/**
 * The nearest triangle on a ray. Source: Moeller and Trumbore, Fast, minimum storage ray/triangle intersection (1997).
 * @param {{positions: Float32Array, faces: Uint32Array}} arrays
 * @param {readonly number[]} from
 * @param {readonly number[]} along
 * @returns {{face: number, far: number}} its number, or -1, and where it is, in lengths of the direction
 */
const firstOn = ({ positions: p, faces }, [ox, oy, oz], [dx, dy, dz]) => {
  let [nearest, found] = [Infinity, -1];
  for (let k = 0; k < faces.length; k += 3) {
    const [a, b, c] = [3 * faces[k], 3 * faces[k + 1], 3 * faces[k + 2]];
    const [ax, ay, az] = [p[a], p[a + 1], p[a + 2]];
    const [ux, uy, uz] = [p[b] - ax, p[b + 1] - ay, p[b + 2] - az];
    const [vx, vy, vz] = [p[c] - ax, p[c + 1] - ay, p[c + 2] - az];
    const [qx, qy, qz] = [dy * vz - dz * vy, dz * vx - dx * vz, dx * vy - dy * vx];
    const det = ux * qx + uy * qy + uz * qz;
    if (det === 0) continue;
    const [sx, sy, sz] = [ox - ax, oy - ay, oz - az];
    const s = (sx * qx + sy * qy + sz * qz) / det;
    if (s < 0 || s > 1) continue;
    const [rx, ry, rz] = [sy * uz - sz * uy, sz * ux - sx * uz, sx * uy - sy * ux];
    const t = (dx * rx + dy * ry + dz * rz) / det;
    if (t < 0 || s + t > 1) continue;
    const far = (vx * rx + vy * ry + vz * rz) / det;
    if (far > 0 && far < nearest) [nearest, found] = [far, k / 3];
  }
  return { face: found, far: nearest };
};

/**
 * @param {{positions: Float32Array, faces: Uint32Array}[]} surfaces
 * @param {number[]} from
 * @param {number[]} along of any length
 * @returns {number[] | null} the first place (x, y, z) on a ray; null: it meets nothing
 */
export const firstPlace = (surfaces, from, along) => {
  const far = Math.min(...surfaces.map((arrays) => firstOn(arrays, from, along).far));
  return Number.isFinite(far) ? from.map((value, k) => value + far * along[k]) : null;
};

/** @param {readonly number[]} a @param {readonly number[]} b */
const angleBetween = (a, b) => {
  const across = Math.hypot(a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]);
  return Math.atan2(across, a[0] * b[0] + a[1] * b[1] + a[2] * b[2]);
};

/**
 * What of a surface is under a place of the picture.
 * @param {{positions: Float32Array, faces: Uint32Array}[]} surfaces
 * @param {Look} look
 * @param {number[]} ndc place in the picture, -1 to 1
 * @param {number[]} step how far off it may be, as its standard deviation along each axis
 * @returns {{place: number[], sigma: number} | null} `sigma`: the same as an angle that the scanner sees, rad, by what is
 *   beside it; null: nothing is there
 */
export const placeUnder = (surfaces, look, ndc, step) => {
  const ray = raysOf(look);
  const at = (/** @type {number} */ u, /** @type {number} */ v) => {
    const { from, along } = ray([u, v]);
    return firstPlace(surfaces, from, along);
  };
  const [[u, v], [du, dv]] = [ndc, step];
  const place = at(u, v);
  if (!place) return null;
  const beside = [[du, 0], [-du, 0], [0, dv], [0, -dv]].map(([a, b]) => at(u + a, v + b));
  return { place, sigma: Math.max(0, ...beside.map((other) => (other ? angleBetween(place, other) : 0))) };
};

/**
 * @param {MeshArrays} arrays the surface of the whole scan
 * @param {Look} look
 * @returns {number[][]} row and column of the grid at the places that the middle and the sides of the picture show, the
 *   one nearest to its middle first
 */
export const cellsInView = (arrays, look) => {
  const ray = raysOf(look);
  const cells = [];
  for (const ndc of AIMED) {
    const { from, along } = ray(ndc);
    const { face } = firstOn(arrays, from, along);
    if (face < 0) continue;
    const corner = arrays.faces[3 * face];
    cells.push([arrays.rows[corner], arrays.columns[corner] % arrays.shape[1]]);
  }
  return cells;
};

/**
 * The finest blocks that cover what is in view: at most two by two.
 * @param {number[][]} cells as `cellsInView` returns them
 * @param {number[]} shape rows and columns of the grid
 * @param {number} vertices of the surface of the whole scan
 * @param {boolean} turns whether the last column is beside the first one
 * @returns {string[]} LEVEL.ROW.COLUMN; none where the whole surface is fine enough
 */
export const blocksAt = (cells, shape, vertices, turns) => {
  if (cells.length < MIN_HITS) return [];
  const [row, column] = cells[0];
  const across = cells.map(([, c]) => {
    const away = c - column;
    return turns ? ((away + 1.5 * shape[1]) % shape[1]) - shape[1] / 2 : away;
  });
  const ends = (/** @type {number[]} */ values) => [Math.min(...values), Math.max(...values)];
  const [top, bottom] = ends(cells.map(([r]) => r));
  const [left, right] = ends(across).map((away) => column + away);
  const count = (/** @type {number} */ level) => 2 ** level;
  /** @param {number} at @param {number} length @param {number} level */
  const blockOf = (at, length, level) => Math.floor((at * count(level)) / length);
  const worth = (/** @type {number} */ level) => {
    const inBlock = (shape[0] * shape[1]) / count(level) ** 2;
    return Math.min(inBlock, BLOCK_VERTICES) * count(level) ** 2 >= WORTHWHILE * vertices && Math.min(...shape) >= MIN_CELLS * count(level);
  };
  for (let level = FINEST_LEVEL; level > 0; level -= 1) {
    const larger = (shape[0] * shape[1]) / count(level - 1) ** 2 <= BLOCK_VERTICES;
    if (!worth(level) || (level > 1 && larger)) continue; // a larger block has all of its cells, too
    const [r0, r1] = [blockOf(top, shape[0], level), blockOf(bottom, shape[0], level)];
    const [c0, c1] = [blockOf(left, shape[1], level), blockOf(right, shape[1], level)];
    if (r1 - r0 > 1 || c1 - c0 > 1) continue;
    return namesOf(level, [r0, r1], [c0, c1], turns);
  }
  // More is in view than blocks may cover: those around its middle.
  let level = 1;
  while (level < FINEST_LEVEL && !worth(level)) level += 1;
  if (!worth(level)) return [];
  const beside = (/** @type {number} */ at, /** @type {number} */ length) => {
    const place = (at * count(level)) / length;
    const first = Math.floor(place - 0.5);
    return [first, first + 1];
  };
  return namesOf(level, beside(row, shape[0]), beside(column, shape[1]), turns);
};

/**
 * @param {number} level
 * @param {readonly number[]} rows first and last
 * @param {readonly number[]} columns first and last
 * @param {boolean} turns
 * @returns {string[]}
 */
const namesOf = (level, [r0, r1], [c0, c1], turns) => {
  const count = 2 ** level;
  const names = new Set();
  for (let r = Math.max(0, r0); r <= Math.min(count - 1, r1); r += 1) {
    for (let c = c0; c <= c1; c += 1) {
      if (!turns && (c < 0 || c >= count)) continue;
      names.add(`${level}.${r}.${((c % count) + count) % count}`);
    }
  }
  return [...names];
};

/**
 * The faces of the whole surface that blocks do not replace; those across the border of one stay, so that no gap is left.
 * @param {MeshArrays} arrays
 * @param {string[]} blocks
 * @returns {Uint32Array}
 */
export const facesBeside = ({ faces, rows, columns, shape }, blocks) => {
  const boxes = blocks.map((name) => {
    const [level, r, c] = name.split(".").map(Number);
    const edge = (/** @type {number} */ k, /** @type {number} */ length) => Math.floor((k * length) / 2 ** level);
    return [edge(r, shape[0]), edge(r + 1, shape[0]), edge(c, shape[1]), edge(c + 1, shape[1])];
  });
  const owner = new Int8Array(rows.length).fill(-1);
  for (let k = 0; k < rows.length; k += 1) {
    owner[k] = boxes.findIndex(([top, bottom, left, right]) => rows[k] >= top && rows[k] < bottom && columns[k] >= left && columns[k] < right);
  }
  const kept = new Uint32Array(faces.length);
  let count = 0;
  for (let k = 0; k < faces.length; k += 3) {
    const [a, b, c] = [owner[faces[k]], owner[faces[k + 1]], owner[faces[k + 2]]];
    if (a >= 0 && a === b && b === c) continue;
    kept.set(faces.subarray(k, k + 3), count);
    count += 3;
  }
  return kept.slice(0, count);
};
