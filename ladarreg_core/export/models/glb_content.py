"""Content of binary glTF 2.0 files: one mesh of textured triangles, with unlit materials."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import ExportError
from ladarreg_core.export.pictures.texture_image import TextureImage

_FLOAT, _UINT = 5126, 5125
_ARRAY_BUFFER, _ELEMENT_BUFFER = 34962, 34963
_LINEAR, _LINEAR_MIPMAP, _CLAMP = 9729, 9987, 33071
_MAX_BYTES = 2**32 - 1  # the header states the length in 32 bits
_BYTES_AT_ONCE = 2**24
_VARIANTS = "KHR_materials_variants"


class GlbContent:
    """Buffer, accessors and materials of a file."""

    def __init__(self) -> None:
        self.size = 0
        """Bytes of the buffer."""
        self._data: list[bytes | memoryview] = []
        self._views: list[dict[str, Any]] = []
        self._accessors: list[dict[str, Any]] = []
        self._materials: list[dict[str, Any]] = []
        self._images: list[dict[str, Any]] = []

    def material(self, name: str, image: TextureImage, *, base: float = 1.0, second_uv: bool = False) -> int:
        """Add an unlit material with a texture, by the first or the second texture coordinates of its primitives."""
        index = len(self._materials)
        self._images.append({"name": name, "bufferView": self._view(image.data), "mimeType": image.media_type})
        color = {
            "baseColorTexture": {"index": index, **({"texCoord": 1} if second_uv else {})},
            "baseColorFactor": [base, base, base, 1.0],
            "metallicFactor": 0.0,
            "roughnessFactor": 1.0,
        }
        unlit: dict[str, Any] = {"KHR_materials_unlit": {}}
        self._materials.append({"name": name, "doubleSided": True, "pbrMetallicRoughness": color, "extensions": unlit})
        return index

    def primitive(
        self,
        vertices: NDArray[Any],
        uv: NDArray[Any],
        faces: NDArray[Any],
        material: int,
        *,
        normals: NDArray[Any] | None = None,
        second_uv: NDArray[Any] | None = None,
        variants: Sequence[int] = (),
    ) -> dict[str, Any]:
        """Add triangles; return the primitive. `variants` are their materials in each variant of the file."""
        placed = np.ascontiguousarray(vertices, dtype="<f4")
        attributes = {"POSITION": self._accessor(placed, "VEC3", _FLOAT, bounds=True)}
        if normals is not None:
            attributes["NORMAL"] = self._accessor(np.ascontiguousarray(normals, dtype="<f4"), "VEC3", _FLOAT)
        attributes["TEXCOORD_0"] = self._accessor(np.ascontiguousarray(uv, dtype="<f4"), "VEC2", _FLOAT)
        if second_uv is not None:
            attributes["TEXCOORD_1"] = self._accessor(np.ascontiguousarray(second_uv, dtype="<f4"), "VEC2", _FLOAT)
        indices = self._accessor(np.ascontiguousarray(faces, dtype="<u4").reshape(-1), "SCALAR", _UINT)
        primitive = {"attributes": attributes, "indices": indices, "material": material, "mode": 4}
        if variants:
            of_material: dict[int, list[int]] = {}
            for variant, chosen in enumerate(variants):
                of_material.setdefault(chosen, []).append(variant)
            mappings = [{"material": chosen, "variants": listed} for chosen, listed in of_material.items()]
            primitive["extensions"] = {_VARIANTS: {"mappings": mappings}}
        return primitive

    def chunks(
        self,
        node: dict[str, Any],
        primitives: list[dict[str, Any]],
        *,
        extras: dict[str, Any] | None = None,
        mark: str = "",
        variants: Sequence[str] = (),
    ) -> Iterator[bytes | memoryview]:
        """Yield the file in pieces.

        Raises:
            ExportError: if it would exceed 4 GB.
        """
        mesh: dict[str, Any] = {"name": "scan", "primitives": primitives}
        document: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "ladarreg", **({"extras": {"pose": mark}} if mark else {})},
            "extensionsUsed": ["KHR_materials_unlit"],
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{**node, "mesh": 0}],
            "meshes": [{**mesh, "extras": extras} if extras else mesh],
            "materials": self._materials,
            "textures": [{"sampler": 0, "source": index} for index in range(len(self._images))],
            "samplers": [{"magFilter": _LINEAR, "minFilter": _LINEAR_MIPMAP, "wrapS": _CLAMP, "wrapT": _CLAMP}],
            "images": self._images,
            "accessors": self._accessors,
            "bufferViews": self._views,
            "buffers": [{"byteLength": self.size}],
        }
        if variants:
            document["extensionsUsed"].append(_VARIANTS)
            document["extensions"] = {_VARIANTS: {"variants": [{"name": name} for name in variants]}}
        text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode("ascii")
        text += b" " * (-len(text) % 4)
        total = 12 + 8 + len(text) + 8 + self.size
        if total > _MAX_BYTES:
            raise ExportError(
                f"the model would have {total / 1e9:.1f} GB, and a GLB file holds at most 4; write it reduced, or "
                "cropped to the photographs"
            )
        header = struct.pack("<4sII", b"glTF", 2, total) + struct.pack("<I4s", len(text), b"JSON")
        return self._pieces(header + text + struct.pack("<I4s", self.size, b"BIN\0"))

    def _pieces(self, start: bytes) -> Iterator[bytes | memoryview]:
        yield start
        for data in self._data:
            for first in range(0, len(data), _BYTES_AT_ONCE):
                yield data[first : first + _BYTES_AT_ONCE]
            yield b"\0" * (-len(data) % 4)

    def _accessor(self, values: NDArray[Any], shape: str, kind: int, *, bounds: bool = False) -> int:
        target = _ELEMENT_BUFFER if kind == _UINT else _ARRAY_BUFFER
        accessor = {
            "bufferView": self._view(values.data.cast("B"), target),
            "componentType": kind,
            "count": len(values),
            "type": shape,
        }
        if bounds:
            accessor |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        self._accessors.append(accessor)
        return len(self._accessors) - 1

    def _view(self, data: bytes | memoryview, target: int | None = None) -> int:
        view = {"buffer": 0, "byteOffset": self.size, "byteLength": len(data)}
        self._views.append(view if target is None else {**view, "target": target})
        self._data.append(data)
        self.size += len(data) + -len(data) % 4
        return len(self._views) - 1
