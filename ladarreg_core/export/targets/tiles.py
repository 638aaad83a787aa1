"""The target `tiles`: the textured model as 3D Tiles 1.1, for viewers that load what they show.

Coordinates of the tiles are the scanner's, z up, in single precision; the root's transform leads to the survey's, in
double precision, without an offset. A tile is replaced by its children. A model of several scans has a tileset for
each, and one that refers to them.

Source: OGC 22-025r4, 3D Tiles 1.1.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from ladarreg_core.export.json import write_document
from ladarreg_core.export.layered_scan import LayeredScan
from ladarreg_core.export.models.glb_content import GlbContent
from ladarreg_core.export.pictures.texture_image import TextureImage, texture_image
from ladarreg_core.export.registered_scan import RegisteredScan
from ladarreg_core.export.targets.folder import FileJob
from ladarreg_core.export.targets.model import model_of
from ladarreg_core.export.targets.target import ExportOptions
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.foundations.progress import Report, part_of
from ladarreg_core.storage.atomic_write import write_bytes
from ladarreg_core.surface.mesh.model_part import ModelPart
from ladarreg_core.surface.mesh.model_tree import ModelTile, ModelTree

TILESET = "tileset.json"
_PAD_M = 1e-6  # of boxes, for the rounding of their numbers
# Viewers of 3D tiles turn glTF, which is Y up, to Z up: X to X, Y to Z, Z to -Y. The node of every GLB undoes that.
_Y_UP_FROM_Z_UP_XYZW = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]


def tiles_files(handed: RegisteredScan, options: ExportOptions, report: Report | None) -> Sequence[FileJob]:
    """Return `tileset.json` and the GLB of every tile, `DEPTH/NUMBER.glb`."""
    return _files(handed, options, report)[1]


def layered_tiles_files(parts: Sequence[LayeredScan], report: Report | None) -> Sequence[FileJob]:
    """Return the same of a model below `tiles/`: the fused colours; of several scans each below a folder of its own."""
    options = ExportOptions()
    if len(parts) == 1:
        return [(f"tiles/{name}", write) for name, write in tiles_files(parts[0].handed, options, report)]
    jobs: list[FileJob] = []
    children = []
    for number, part in enumerate(parts, start=1):
        part_report = part_of(report, (number - 1) / len(parts), number / len(parts))
        tileset, files = _files(part.handed, options, part_report)
        jobs += [(f"tiles/{number}/{name}", write) for name, write in files]
        children.append({
            "boundingVolume": {"box": _outside(tileset["root"])},
            "geometricError": tileset["geometricError"],
            "content": {"uri": f"{number}/{TILESET}"},
        })  # fmt: skip
    corners = np.concatenate([_corners(one["boundingVolume"]["box"]) for one in children])
    low, high = corners.min(axis=0), corners.max(axis=0)
    whole = {
        "boundingVolume": {"box": [*((low + high) / 2).tolist(), *np.diag((high - low) / 2).ravel().tolist()]},
        "geometricError": float(np.linalg.norm(high - low)),
        "refine": "ADD",
        "children": children,
    }
    document = {"asset": {"version": "1.1"}, "geometricError": whole["geometricError"], "root": whole}
    return [(f"tiles/{TILESET}", lambda path: write_document(path, document)), *jobs]


def _files(
    handed: RegisteredScan, options: ExportOptions, report: Report | None
) -> tuple[dict[str, Any], Sequence[FileJob]]:
    tree = ModelTree(model_of(handed, options, report).parts)
    tiles = tree.root.tiles
    numbers: dict[int, int] = {}
    names = {}
    for tile in tiles:
        number = numbers.get(tile.depth, 0)
        names[tile] = f"{tile.depth}/{number}.glb"
        numbers[tile.depth] = number + 1
    photos = [one.photo.name for one in handed.photos]
    mark = "; ".join(handed.marks)

    def writer(tile: ModelTile) -> Callable[[Path], None]:
        def write(path: Path) -> None:
            parts = [
                (each.part, texture_image(each.part.tile.pixels(each.longest_px), lossless=False))
                for each in tree.content(tile)
            ]
            write_bytes(path, _glb(parts, names=photos, mark=mark))

        return write

    document = _tileset(handed, tree.root, names)
    return document, [
        (TILESET, lambda path: write_document(path, document)),
        *((names[tile], writer(tile)) for tile in tiles),
    ]


def _outside(root: dict[str, Any]) -> list[float]:
    """Return the box of a root as the tile that refers to its tileset sees it: moved by the root's transform."""
    box = np.array(root["boundingVolume"]["box"]).reshape(4, 3)
    transform = np.array(root.get("transform", np.eye(4).ravel())).reshape(4, 4).T
    moved = box @ transform[:3, :3].T
    moved[0] += transform[:3, 3]
    return list(map(float, moved.ravel()))


def _corners(box: Sequence[float]) -> FloatArray:
    """Return the corners (8, 3) of a box: its centre, and the halves of its edges."""
    centre, *edges = np.array(box, np.float64).reshape(4, 3)
    return np.array([centre + np.array(signs) @ np.array(edges) for signs in product((-1.0, 1.0), repeat=3)])


def _glb(parts: Sequence[tuple[ModelPart, TextureImage]], *, names: Sequence[str], mark: str) -> bytes:
    """Return the content of a tile: parts with their textures, in the tile's axes."""
    content, primitives = GlbContent(), []
    for part, image in parts:
        material = content.material("laser intensity" if part.photo is None else names[part.photo], image)
        primitives.append(content.primitive(part.vertices, part.uv, part.faces, material, normals=part.normals))
    node: dict[str, Any] = {"name": "tile, Z up, metres", "rotation": _Y_UP_FROM_Z_UP_XYZW}
    return b"".join(content.chunks(node, primitives, mark=mark))


def _tileset(handed: RegisteredScan, root: ModelTile, names: dict[ModelTile, str]) -> dict[str, Any]:
    frame = handed.frame
    top = _tile(root, names)
    sentence = "scanner frame, X forward, Y left, Z up; metres; not georeferenced"
    if frame.name == "world":
        top["transform"] = frame.world_from_scanner.matrix.T.ravel().tolist()  # column by column
        sentence = "world frame, as the scan's file states it, Z up; metres; nothing is subtracted"
    extras = {
        "frame": frame.name,
        "frame_is": sentence,
        "photos": [one.photo.name for one in handed.photos],
        **({"poses": list(handed.marks)} if handed.marks else {}),
    }
    return {
        "asset": {"version": "1.1", "extras": extras},
        "geometricError": float(np.linalg.norm(root.high - root.low)),
        "root": {**top, "refine": "REPLACE"},
    }


def _tile(tile: ModelTile, names: dict[ModelTile, str]) -> dict[str, Any]:
    centre, half = (tile.high + tile.low) / 2, (tile.high - tile.low) / 2 + _PAD_M
    document: dict[str, Any] = {
        "boundingVolume": {"box": [*centre.tolist(), *np.diag(half).ravel().tolist()]},
        "geometricError": tile.error_m,
        "content": {"uri": names[tile]},
    }
    if tile.children:
        document["children"] = [_tile(child, names) for child in tile.children]
    return document
