"""The rules of glTF 2.0 that matter for the files written here, checked on the bytes of a GLB.

They are those of the specification's chapters on the container, buffers, accessors, meshes, images and materials.
"""

from __future__ import annotations

import io
import json
import struct
from typing import Any

import numpy as np
from PIL import Image

_TYPES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}
_COMPONENTS = {5125: "<u4", 5126: "<f4"}
_ARRAY_BUFFER, _ELEMENT_BUFFER = 34962, 34963
_MAGIC = {"image/png": b"\x89PNG\r\n\x1a\n", "image/jpeg": b"\xff\xd8\xff"}
_FILTERS, _WRAPS = {9728, 9729, 9984, 9985, 9986, 9987}, {33071, 33648, 10497}


class Glb:
    """A GLB, checked; raises AssertionError at the first rule that is broken."""

    def __init__(self, data: bytes) -> None:
        magic, version, total = struct.unpack_from("<4sII", data)
        assert (magic, version, total) == (b"glTF", 2, len(data))
        json_size, json_kind = struct.unpack_from("<I4s", data, 12)
        assert json_kind == b"JSON"
        assert json_size % 4 == 0
        text = data[20 : 20 + json_size]
        assert not text.startswith(b"\xef\xbb\xbf")
        self.document: dict[str, Any] = json.loads(text, parse_constant=_no_constant)
        size, kind = struct.unpack_from("<I4s", data, 20 + json_size)
        assert kind == b"BIN\0"
        assert size % 4 == 0
        assert 28 + json_size + size == total
        self.body = data[28 + json_size :]
        self._check()

    def accessor(self, index: int) -> np.ndarray:
        """Return the values of an accessor (N,) or (N, K)."""
        accessor = self.document["accessors"][index]
        view = self.document["bufferViews"][accessor["bufferView"]]
        count = accessor["count"] * _TYPES[accessor["type"]]
        values = np.frombuffer(self.body, _COMPONENTS[accessor["componentType"]], count, view["byteOffset"])
        return values if accessor["type"] == "SCALAR" else values.reshape(accessor["count"], -1)

    def image(self, index: int) -> np.ndarray:
        """Return the pixels (h, w, 3) of an image."""
        return np.asarray(Image.open(io.BytesIO(self._image_bytes(index))).convert("RGB"))

    def _image_bytes(self, index: int) -> bytes:
        view = self.document["bufferViews"][self.document["images"][index]["bufferView"]]
        return self.body[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]

    def _check(self) -> None:
        document = self.document
        assert document["asset"]["version"] == "2.0"
        (buffer,) = document["buffers"]
        assert "uri" not in buffer
        assert len(self.body) - 3 <= buffer["byteLength"] <= len(self.body)
        self._check_views(buffer["byteLength"])
        for accessor in document["accessors"]:
            self._check_accessor(accessor)
        for mesh in document["meshes"]:
            assert mesh["primitives"]
            for primitive in mesh["primitives"]:
                self._check_primitive(primitive)
        for index, image in enumerate(document["images"]):
            assert ("uri" in image) != ("bufferView" in image)
            data = self._image_bytes(index)
            assert data.startswith(_MAGIC[image["mimeType"]])
            assert Image.open(io.BytesIO(data)).format == {"image/png": "PNG", "image/jpeg": "JPEG"}[image["mimeType"]]
        for texture in document["textures"]:
            assert 0 <= texture["source"] < len(document["images"])
            assert 0 <= texture["sampler"] < len(document["samplers"])
        for sampler in document["samplers"]:
            assert {sampler["magFilter"], sampler["minFilter"]} <= _FILTERS
            assert {sampler["wrapS"], sampler["wrapT"]} <= _WRAPS
        for material in document["materials"]:
            color = material["pbrMetallicRoughness"]
            assert 0 <= color["baseColorTexture"]["index"] < len(document["textures"])
            assert len(color["baseColorFactor"]) == 4
            assert set(material.get("extensions", {})) <= set(document["extensionsUsed"])
        self._check_nodes()

    def _check_views(self, length: int) -> None:
        end = 0
        for view in self.document["bufferViews"]:
            assert view["buffer"] == 0
            assert view["byteOffset"] % 4 == 0
            assert view["byteOffset"] >= end
            assert view["byteLength"] >= 1
            end = view["byteOffset"] + view["byteLength"]
            assert end <= length
            assert view.get("target", _ARRAY_BUFFER) in (_ARRAY_BUFFER, _ELEMENT_BUFFER)

    def _check_accessor(self, accessor: dict[str, Any]) -> None:
        assert accessor["count"] >= 1
        view = self.document["bufferViews"][accessor["bufferView"]]
        assert accessor.get("byteOffset", 0) + accessor["count"] * 4 * _TYPES[accessor["type"]] <= view["byteLength"]
        values = self.accessor(self.document["accessors"].index(accessor))
        if accessor["componentType"] == 5126:
            assert np.isfinite(values).all()
        for name, found in (("min", values.min(axis=0)), ("max", values.max(axis=0))):
            if name in accessor:
                np.testing.assert_array_equal(np.float32(accessor[name]), found)

    def _check_primitive(self, primitive: dict[str, Any]) -> None:
        accessors, attributes = self.document["accessors"], primitive["attributes"]
        counts = {accessors[index]["count"] for index in attributes.values()}
        assert len(counts) == 1
        assert {"min", "max"} <= set(accessors[attributes["POSITION"]])
        for name, kind in {"POSITION": "VEC3", "NORMAL": "VEC3", "TEXCOORD_0": "VEC2"}.items():
            if name in attributes:
                accessor = accessors[attributes[name]]
                assert (accessor["type"], accessor["componentType"]) == (kind, 5126)
                assert self.document["bufferViews"][accessor["bufferView"]]["target"] == _ARRAY_BUFFER
        if "NORMAL" in attributes:
            lengths = np.linalg.norm(self.accessor(attributes["NORMAL"]), axis=1)
            np.testing.assert_allclose(lengths, 1, atol=5e-3)  # the tolerance of Khronos' validator
        indices = accessors[primitive["indices"]]
        assert (indices["type"], indices["componentType"]) == ("SCALAR", 5125)
        assert self.document["bufferViews"][indices["bufferView"]]["target"] == _ELEMENT_BUFFER
        assert not {"min", "max"} & set(indices)
        corners = self.accessor(primitive["indices"])
        assert len(corners) % 3 == 0
        assert corners.max() < counts.pop()
        triangles = corners.reshape(-1, 3)
        assert (triangles != np.roll(triangles, 1, axis=1)).all()  # none is degenerate
        assert primitive.get("mode", 4) == 4
        assert 0 <= primitive["material"] < len(self.document["materials"])

    def _check_nodes(self) -> None:
        document = self.document
        assert 0 <= document["scene"] < len(document["scenes"])
        for node in document["nodes"]:
            assert 0 <= node["mesh"] < len(document["meshes"])
            if "rotation" in node:
                assert abs(np.linalg.norm(node["rotation"]) - 1) < 1e-6
        for scene in document["scenes"]:
            assert all(0 <= index < len(document["nodes"]) for index in scene["nodes"])


def _no_constant(word: str) -> None:
    raise AssertionError(f"{word} is no JSON")
