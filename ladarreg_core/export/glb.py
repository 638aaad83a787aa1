"""Export of the textured 2.5-D model as binary glTF."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ladarreg_core.arrays import ByteArray, read_only
from ladarreg_core.errors import ExportError
from ladarreg_core.export.atomic_write import write_bytes
from ladarreg_core.export.output_frame import OutputFrame
from ladarreg_core.export.viser_colors import VISER_BASE_COLOUR, texture_for_viewer
from ladarreg_core.surface.mesh import Mesh

_LARGEST_TEXTURE_PX = 8192
# glTF is Y up, and viewers start by looking along -Z: the scanner's X goes there, its Y to -X, its Z to Y.
_GLTF_FROM_SCANNER_XYZW = [-0.5, 0.5, 0.5, 0.5]
_GLTF_FROM_WORLD_XYZW = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]  # X stays, Y goes to -Z, Z goes to Y
SCANNER_FRAME = OutputFrame()
_FLOAT, _UINT = 5126, 5125
_ARRAY_BUFFER, _ELEMENT_BUFFER = 34962, 34963
_LINEAR, _LINEAR_MIPMAP, _CLAMP = 9729, 9987, 33071
_PNG_COMPRESSION = 4


def write_glb(
    path: str | Path,
    mesh: Mesh,
    picture: ByteArray,
    *,
    for_viser: bool = False,
    frame: OutputFrame = SCANNER_FRAME,
    tolerance_m: float = 0.0,
    mark: str = "",
) -> None:
    """Write a model to a GLB file; see `glb_bytes`.

    Raises:
        ExportError: if the mesh has no faces or the file cannot be written.
    """
    write_bytes(path, glb_bytes(mesh, picture, for_viser=for_viser, frame=frame, tolerance_m=tolerance_m, mark=mark))


def glb_bytes(
    mesh: Mesh,
    picture: ByteArray,
    *,
    for_viser: bool = False,
    frame: OutputFrame = SCANNER_FRAME,
    largest_texture_px: int = _LARGEST_TEXTURE_PX,
    tolerance_m: float = 0.0,
    mark: str = "",
) -> bytes:
    """Return a model as GLB: one unlit mesh with its texture, in metres.

    Vertices are in the scanner frame (X forward, Y left, Z up), or in the world's less the offset that the root node's
    extras state; that node rotates them into glTF's frame.

    Args:
        mesh: the mesh.
        picture: texture over the whole scan grid, (h, w, 3) uint8 RGB of any size; reduced if it is too large.
        for_viser: target viser's scene, which uses the scanner frame and tone mapping: no root rotation, and a texture
            that has the true colours after tone mapping.
        frame: the frame of the vertices; viser's scene has the scanner's.
        largest_texture_px: limit of the texture's longer side, at most 8192.
        tolerance_m: error that the mesh was reduced by, m, stated in the extras of the mesh; 0: it was not.
        mark: what the file must say of a pose that was not verified, in the extras of `asset` and of the root node.

    Raises:
        ShapeError: if the texture is not an RGB image.
        ExportError: if the mesh has no faces.
    """
    if not len(mesh.faces):
        raise ExportError("the scan has no surface: no three neighbouring cells are connected; no model is written")
    pixels = read_only(picture, np.uint8, (None, None, 3), "the model's texture")
    longest, largest = max(pixels.shape[:2]), min(largest_texture_px, _LARGEST_TEXTURE_PX)
    if longest > largest:
        height, width = (max(1, round(n * largest / longest)) for n in pixels.shape[:2])
        pixels = np.asarray(cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)
    if for_viser:
        pixels = texture_for_viewer(pixels)
    done, encoded = cv2.imencode(".png", pixels[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, _PNG_COMPRESSION])
    assert done, "an 8-bit image can always be encoded"

    vertices = np.ascontiguousarray(frame.place(mesh.vertices), dtype="<f4")
    chunks = [
        vertices.tobytes(),
        np.ascontiguousarray(mesh.uv, dtype="<f4").tobytes(),
        np.ascontiguousarray(mesh.faces, dtype="<u4").tobytes(),
        encoded.tobytes(),
    ]
    body, views = b"", []
    offset = 0
    for chunk, target in zip(chunks, (_ARRAY_BUFFER, _ARRAY_BUFFER, _ELEMENT_BUFFER, None), strict=True):
        view: dict[str, Any] = {"buffer": 0, "byteOffset": offset, "byteLength": len(chunk)}
        if target is not None:
            view["target"] = target
        views.append(view)
        offset += len(chunk) + -len(chunk) % 4
    body = b"".join(chunk + b"\0" * (-len(chunk) % 4) for chunk in chunks)
    node: dict[str, Any] = {"name": "scanner frame: X forward, Y left, Z up, metres", "mesh": 0}
    if not for_viser:
        node["rotation"] = _GLTF_FROM_SCANNER_XYZW
    if frame.name == "world":
        node |= {"name": frame.sentence, "extras": frame.as_dict(), "rotation": _GLTF_FROM_WORLD_XYZW}
    if mark:
        node["extras"] = {**node.get("extras", {}), "pose": mark}
    base = VISER_BASE_COLOUR if for_viser else 1.0
    document = {
        "asset": {"version": "2.0", "generator": "ladarreg", **({"extras": {"pose": mark}} if mark else {})},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [
            {
                "name": "scan",
                **({"extras": {"reduced_to_error_m": tolerance_m}} if tolerance_m else {}),
                "primitives": [
                    {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0, "mode": 4}
                ],
            }
        ],
        "materials": [
            {
                "name": "photo on scan",
                "doubleSided": True,
                "pbrMetallicRoughness": {
                    "baseColorTexture": {"index": 0},
                    "baseColorFactor": [base, base, base, 1.0],
                    "metallicFactor": 0.0,
                    "roughnessFactor": 1.0,
                },
                "extensions": {"KHR_materials_unlit": {}},
            }
        ],
        "textures": [{"sampler": 0, "source": 0}],
        "samplers": [{"magFilter": _LINEAR, "minFilter": _LINEAR_MIPMAP, "wrapS": _CLAMP, "wrapT": _CLAMP}],
        "images": [{"name": "registered", "bufferView": 3, "mimeType": "image/png"}],
        "accessors": [
            {
                "bufferView": 0,
                "componentType": _FLOAT,
                "count": len(vertices),
                "type": "VEC3",
                "min": vertices.min(axis=0).tolist(),
                "max": vertices.max(axis=0).tolist(),
            },
            {"bufferView": 1, "componentType": _FLOAT, "count": len(vertices), "type": "VEC2"},
            {"bufferView": 2, "componentType": _UINT, "count": int(mesh.faces.size), "type": "SCALAR"},
        ],
        "bufferViews": views,
        "buffers": [{"byteLength": len(body)}],
    }
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode("ascii")
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + len(body)
    header = struct.pack("<4sII", b"glTF", 2, total)
    return header + struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + body
