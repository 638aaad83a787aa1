/** The parts of the 3-D model, as the workbench sends them: meshes and textures (docs/workbench.md, pictures and files). */

const RECENT = 6; // textures that are shown again without a transfer, the one in use included
const RECENT_BLOCKS = 12; // of the surface, those in use included
const HEADER_BYTES = 28;

/**
 * @typedef {{positions: Float32Array, uv: Float32Array, faces: Uint32Array, rows: Int32Array, columns: Int32Array,
 *   shape: number[]}} MeshArrays `rows` and `columns` of the vertices in the scan's grid, which has `shape`
 */

/**
 * @typedef {{signal: AbortSignal, progress: (got: number, total: number) => void}} Download how a part is downloaded
 */

/** @param {string} part @param {Record<string, string>} fields */
const addressOf = (part, fields) => `picture/model/${part}?${new URLSearchParams(fields)}`;

/** @param {string} scan @param {string} detail @returns {string} */
export const meshAddress = (scan, detail) => addressOf("mesh", { detail, rev: scan });

/**
 * @param {string} scan
 * @param {string} block
 * @returns {string} the surface of a block of the scan's grid, LEVEL.ROW.COLUMN
 */
export const blockAddress = (scan, block) => addressOf("mesh", { block, rev: scan });

/**
 * @param {string | null} photo
 * @param {string} kind
 * @param {{z_buffer: boolean, rev: string}} model
 * @param {string} detail
 * @returns {string}
 */
export const textureAddress = (photo, kind, { z_buffer, rev }, detail) =>
  addressOf("texture", { photo: photo ?? "none", kind, z_buffer: z_buffer ? "1" : "0", detail, rev });

/**
 * @param {string} photo
 * @param {{rev: string}} model
 * @param {string} detail
 * @returns {{mesh: string, picture: string}} the triangles that the camera sees, and the photograph to draw on them
 */
export const layerAddress = (photo, { rev }, detail) => ({
  mesh: addressOf("layer", { photo, detail, rev }),
  picture: addressOf("photo", { photo, detail, rev }),
});

/** @param {{id: string, rev?: string}} photo @returns {string} a photograph as it is shown at once, of its own size */
export const pictureAddress = ({ id, rev }) => `picture/photo/${encodeURIComponent(id)}?rev=${encodeURIComponent(rev ?? id)}&form=quick`;

/**
 * Download a part.
 * @param {string} address
 * @param {Download} options
 * @returns {Promise<{blob: Blob, headers: Headers}>}
 */
const download = async (address, { signal, progress }) => {
  const answer = await fetch(address, { signal });
  if (!answer.ok) throw new Error((await answer.text()).trim());
  const total = Number(answer.headers.get("content-length"));
  /** @type {Uint8Array[]} */
  const pieces = [];
  let got = 0;
  progress(0, total);
  for (const reader = answer.body?.getReader(); reader;) {
    const { done, value } = await reader.read();
    if (done) break;
    pieces.push(value);
    got += value.length;
    progress(got, Math.max(got, total));
  }
  return { blob: new Blob(pieces, { type: answer.headers.get("content-type") ?? "" }), headers: answer.headers };
};

/** @param {Uint8Array} bytes @param {number} start @param {number} count */
const integers = (bytes, start, count) => {
  const found = new Int32Array(count);
  for (let k = 0; k < count; k += 1) {
    const at = start + k;
    const zigzag =
      bytes[at] | (bytes[at + count] << 8) | (bytes[at + 2 * count] << 16) | (bytes[at + 3 * count] << 24);
    found[k] = (zigzag >>> 1) ^ -(zigzag & 1);
  }
  return found;
};

/** @param {Int32Array} differences */
const summed = (differences) => {
  for (let k = 1; k < differences.length; k += 1) differences[k] += differences[k - 1];
  return differences;
};

/**
 * Decode a mesh; ladarreg_core/export/models/packed_mesh.py describes the format.
 * @param {ArrayBuffer} buffer decompressed
 * @returns {MeshArrays}
 */
export const decodeMesh = (buffer) => {
  const view = new DataView(buffer);
  const [vertices, triangles, rows, columns] = [4, 8, 12, 16].map((at) => view.getUint32(at, true));
  const unit = view.getFloat64(20, true);
  const bytes = new Uint8Array(buffer);
  let at = HEADER_BYTES;
  const next = (/** @type {number} */ count) => {
    const found = integers(bytes, at, count);
    at += 4 * count;
    return found;
  };
  const [x, y, z, row, column] = Array.from({ length: 5 }, () => summed(next(vertices)));
  const [first, second, third] = [summed(next(triangles)), next(triangles), next(triangles)];
  const positions = new Float32Array(3 * vertices);
  const uv = new Float32Array(2 * vertices);
  for (let k = 0; k < vertices; k += 1) {
    positions.set([x[k] * unit, y[k] * unit, z[k] * unit], 3 * k);
    uv.set([(column[k] + 0.5) / columns, (row[k] + 0.5) / rows], 2 * k);
  }
  const faces = new Uint32Array(3 * triangles);
  for (let k = 0; k < triangles; k += 1) faces.set([first[k], first[k] + second[k], first[k] + third[k]], 3 * k);
  return { positions, uv, faces, rows: row, columns: column, shape: [rows, columns] };
};

/** @param {Blob} blob */
const decompressed = (blob) => new Response(blob.stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();

/** @param {Headers} headers @returns {import("./model_legend.js").Legend | null} */
const legendOf = (headers) => {
  const text = headers.get("x-legend");
  return text ? JSON.parse(decodeURIComponent(text)) : null;
};

/** @template Part @param {Map<string, Part>} parts the newest last @param {number} most */
const keepNewest = (parts, most) => {
  for (const oldest of parts.keys()) {
    if (parts.size <= most) return;
    parts.delete(oldest);
  }
};

/** @typedef {{blob: Blob, legend: import("./model_legend.js").Legend | null}} Texture */

/** Parts that were downloaded: the meshes of one scan, and the textures that were used last. */
export class ModelParts {
  /** @type {Map<string, MeshArrays>} */
  #meshes = new Map();
  /** @type {Map<string, Texture>} */
  #textures = new Map();
  /** @type {Map<string, MeshArrays | null>} */
  #blocks = new Map();
  /**
   * @type {{address: {mesh: string, picture: string}, found: {arrays: MeshArrays, blob: Blob} | null} | null} the latest:
   *   the largest that the page keeps
   */
  #layer = null;

  /** @param {string} address @param {Download} options @returns {Promise<MeshArrays>} */
  async mesh(address, options) {
    const known = this.#meshes.get(address);
    if (known) return known;
    const { blob } = await download(address, options);
    const arrays = decodeMesh(await decompressed(blob));
    this.#meshes.set(address, arrays);
    return arrays;
  }

  /** @param {string} address @param {Download} options @returns {Promise<MeshArrays | null>} the surface of a block; null where it has none */
  async block(address, options) {
    let arrays = this.#blocks.get(address);
    if (arrays === undefined) {
      const { blob } = await download(address, options);
      arrays = blob.size ? decodeMesh(await decompressed(blob)) : null;
    }
    this.#blocks.delete(address);
    this.#blocks.set(address, arrays); // the newest last
    keepNewest(this.#blocks, RECENT_BLOCKS);
    return arrays;
  }

  /** @param {string} address @param {Download} options @returns {Promise<Texture>} */
  async texture(address, options) {
    const found = this.#textures.get(address) ?? (await this.#downloaded(address, options));
    this.#textures.delete(address);
    this.#textures.set(address, found); // the newest last
    keepNewest(this.#textures, RECENT);
    return found;
  }

  /**
   * @param {{mesh: string, picture: string}} address
   * @param {{signal: AbortSignal, progress: (name: string) => Download["progress"]}} options
   * @returns {Promise<{arrays: MeshArrays, blob: Blob} | null>} null where the camera sees no triangle
   */
  async layer(address, { signal, progress }) {
    if (this.#layer?.address.mesh === address.mesh) return this.#layer.found;
    this.#layer = null;
    const { blob: packed } = await download(address.mesh, { signal, progress: progress("layer") });
    let found = null;
    if (packed.size) {
      const { blob } = await download(address.picture, { signal, progress: progress("photo") });
      found = { arrays: decodeMesh(await decompressed(packed)), blob };
    }
    this.#layer = { address, found };
    return found;
  }

  /** Drop the meshes of another scan. */
  clear() {
    this.#layer = null;
    this.#meshes.clear();
    this.#blocks.clear();
    this.#textures.clear();
  }

  /** @param {string} address @param {Download} options @returns {Promise<Texture>} */
  async #downloaded(address, options) {
    const { blob, headers } = await download(address, options);
    return { blob, legend: legendOf(headers) };
  }
}
