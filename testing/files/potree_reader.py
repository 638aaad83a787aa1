"""A reader of what Potree 1.8 reads, written from its loaders: nodes of an octree, oriented and 360-degree images.

Source: Potree 1.8, `OctreeLoader.js`, `DecoderWorker.js`, `OrientedImages.js`, `Images360.js`.
"""

from __future__ import annotations

import json
import re
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

NODE = struct.Struct("<BBIqq")
TYPES = {"int32": "<i4", "uint16": "<u2", "uint8": "|u1", "float": "<f4", "double": "<f8"}


@dataclass
class Node:
    """A node with its cube and its points."""

    name: str
    low: np.ndarray
    high: np.ndarray
    children: list[Node] = field(default_factory=list)
    records: np.ndarray = field(default_factory=lambda: np.empty(0))
    points: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))

    @property
    def all(self) -> list[Node]:
        """The node and all below it."""
        return [self, *(below for child in self.children for below in child.all)]


@dataclass
class Cloud:
    """A cloud as Potree has it in memory once all nodes are loaded."""

    metadata: dict[str, Any]
    root: Node

    @property
    def points(self) -> np.ndarray:
        return np.concatenate([node.points for node in self.root.all])

    @property
    def records(self) -> np.ndarray:
        return np.concatenate([node.records for node in self.root.all])


def read_cloud(folder: Path) -> Cloud:
    """Read all nodes of `metadata.json`, `hierarchy.bin` and `octree.bin`."""
    metadata = json.loads((folder / "metadata.json").read_text(encoding="utf-8"))
    assert metadata["encoding"] != "BROTLI"
    hierarchy, data = (folder / "hierarchy.bin").read_bytes(), (folder / "octree.bin").read_bytes()
    dtype = np.dtype([_field(one) for one in metadata["attributes"]])
    box = metadata["boundingBox"]
    root = Node("r", np.array(box["min"]), np.array(box["max"]))
    piece = hierarchy[: metadata["hierarchy"]["firstChunkSize"]]
    nodes, at = [root], 0
    while at * NODE.size < len(piece):
        node = nodes[at]
        kind, mask, count, start, size = NODE.unpack_from(piece, at * NODE.size)
        assert kind in (0, 1), "further pieces of the hierarchy are not expected"
        assert size == count * dtype.itemsize
        node.records = np.frombuffer(data, dtype, count, start)
        node.points = node.records["position"] * np.array(metadata["scale"]) + np.array(metadata["offset"])
        for k in range(8):
            if mask >> k & 1:
                node.children.append(_child(node, k))
                nodes.append(node.children[-1])
        at += 1
    assert at == len(nodes), "the hierarchy has as many records as its masks name"
    return Cloud(metadata, root)


def _field(attribute: dict[str, Any]) -> tuple[Any, ...]:
    dtype = np.dtype(TYPES[attribute["type"]])
    assert attribute["elementSize"] == dtype.itemsize
    assert attribute["size"] == dtype.itemsize * attribute["numElements"]
    assert len(attribute["min"]) == len(attribute["max"]) == attribute["numElements"]
    shape = () if attribute["numElements"] == 1 else (attribute["numElements"],)
    return attribute["name"], dtype, shape


def _child(node: Node, k: int) -> Node:
    low, high = node.low.copy(), node.high.copy()
    half = (high - low) / 2
    for axis, bit in ((2, 1), (1, 2), (0, 4)):
        if k & bit:
            low[axis] += half[axis]
        else:
            high[axis] -= half[axis]
    return Node(f"{node.name}{k}", low, high)


@dataclass
class OrientedImage:
    """A plane that Potree shows at a camera's place."""

    file: Path
    width: int
    height: int
    place: np.ndarray
    corner: np.ndarray
    """The corner of the plane at the picture's lower left."""
    right: np.ndarray
    up: np.ndarray
    """Its sides."""

    def pixels(self, points: np.ndarray) -> np.ndarray:
        """Return where the plane is met on the way from its camera's place to points, px; NaN behind the camera."""
        rays = points - self.place
        normal = np.cross(self.right, self.up)
        ahead = rays @ normal
        facing = (self.corner - self.place) @ normal
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.where(ahead * facing > 0, facing / ahead, np.nan)
        on_plane = self.place + rays * share[:, None] - self.corner
        s = on_plane @ self.right / (self.right @ self.right)
        t = on_plane @ self.up / (self.up @ self.up)
        return np.stack([s * self.width - 0.5, (1 - t) * self.height - 0.5], axis=-1)


def read_oriented(camera: Path, listed: Path) -> list[OrientedImage]:
    """Read the images of one camera, as `OrientedImageLoader.load` with these two paths."""
    text = camera.read_text(encoding="utf-8")
    width, height, f = (float(re.findall(rf"<{name}>([^<]*)</{name}>", text)[0]) for name in ("width", "height", "f"))
    half_angle = np.arctan(height / 2 / f)
    images = []
    for line in listed.read_text(encoding="utf-8").split("\n")[1:]:
        tokens = line.split()
        if line.startswith("#") or len(tokens) < 6:
            continue
        place = np.array([float(token) for token in tokens[1:4]])
        turn = Rotation.from_euler("XYZ", [float(token) for token in tokens[4:7]], degrees=True).as_matrix()
        middle = place + turn[:, 2] * -0.5 / np.tan(half_angle)
        right, up = turn[:, 0] * width / height, turn[:, 1]
        corner = middle - right / 2 - up / 2
        images.append(OrientedImage(listed.parent / tokens[0], int(width), int(height), place, corner, right, up))
    return images


@dataclass
class Image360:
    """A sphere that Potree shows at a camera's place."""

    file: Path
    place: np.ndarray
    turn: np.ndarray
    """(3, 3) world from the sphere of three.js."""

    def shares(self, points: np.ndarray) -> np.ndarray:
        """Return where the picture is met on the way to points: shares of its width and its height."""
        x, y, z = ((points - self.place) @ self.turn).T
        # SphereGeometry: x = -cos(2 pi u) sin(pi v), y = cos(pi v), z = sin(2 pi u) sin(pi v); the texture is mirrored.
        u = np.arctan2(z, -x) / (2 * np.pi) % 1
        v = np.arccos(y / np.linalg.norm(points - self.place, axis=1)) / np.pi
        return np.stack([1 - u, v], axis=-1)


def read_panoramas(folder: Path) -> list[Image360]:
    """Read the images of a folder, as `Images360Loader.load`."""
    images = []
    for line in (folder / "coordinates.txt").read_text(encoding="utf-8").split("\n")[1:]:
        if not line.strip():
            continue
        name, _, x, y, z, course, pitch, roll = line.split("\t")
        angles = [-float(course) + 90, -float(pitch), float(roll) + 90]
        turn = Rotation.from_euler("ZYX", angles, degrees=True).as_matrix()
        images.append(Image360(folder / name.replace('"', ""), np.array([float(x), float(y), float(z)]), turn))
    return images
