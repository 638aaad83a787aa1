"""A cloud as a Potree 2 octree: `octree.bin`, `hierarchy.bin` and `metadata.json`, without compression.

Every point stands in one node. An inner node has one point for each cell of a grid of 128 cells along its cube, the
others go on to its children; a node with few points keeps all of them. Which nodes a point passes depends only on the
points of its own cell, so that the cloud is sorted into parts first and each part is then made alone: memory does not
grow with the cloud.

Source: Potree 1.8, `src/modules/loader/2.0/OctreeLoader.js` and `DecoderWorker.js`, for what is read; PotreeConverter
2.1, `Converter/src/indexer.cpp`, for the fields of `metadata.json`.
"""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.export.clouds.cloud_part import CloudPart, CloudRows, SixteenBitIntensity, cloud_points, cloud_rows
from ladarreg_core.export.json import write_document
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.storage.atomic_write import cannot_write, sync_file, write_bytes
from ladarreg_core.surface.texture.registered_texture import Label

_SCALE_M = 1e-4
_COARSER_SCALE_M = 1e-3
_LARGEST_INTEGER = 2**31 - 1
_CORNER_ROUNDED_TO_M = 1e-3
_SMALLEST_CUBE_M = 1e-2
_GRID_DEPTH = 7  # the cells of a node: 2**7 along its cube, as PotreeConverter's
_KEY_DEPTH = 21  # of keys of 63 bits
_MAX_DEPTH = _KEY_DEPTH - _GRID_DEPTH
_PART_DEPTH = 7
_MAX_PART_POINTS = 2_000_000
_MAX_LEAF_POINTS = 10_000
_NODE_BYTES = 22
_PASSES, _SORTING = 4, "sorting the cloud"
_HASH = np.uint64(0x9E3779B97F4A7C15)  # of Fibonacci hashing
_SIXTEEN_BITS = np.uint16(257)  # 255 becomes 65535
_HEAD = [("position", "<i4", 3), ("intensity", "<u2"), ("rgb", "<u2", 3), ("label", "|u1"), ("photo_id", "<u2")]
_TYPES = {"|u1": "uint8", "<u2": "uint16", "<i4": "int32", "<f4": "float"}


@dataclass(frozen=True, slots=True, eq=False)
class NumberedPart:
    """A part of the cloud, whose colours are of the photographs from `first_photo` on, from 1."""

    part: CloudPart
    first_photo: int


@dataclass(slots=True)
class _Node:
    offset: int
    points: int


@dataclass(slots=True)
class _Range:
    """The smallest and the largest values of an attribute; those that are not known do not count."""

    low: list[float] = field(default_factory=list)
    high: list[float] = field(default_factory=list)

    def add(self, values: NDArray[Any]) -> None:
        rows = values.reshape(len(values), -1)
        if rows.dtype.kind == "f":
            rows = rows[np.isfinite(rows).all(axis=1)]
        if not len(rows):
            return
        low, high = rows.min(axis=0).tolist(), rows.max(axis=0).tolist()
        self.low = [min(pair) for pair in zip(self.low, low, strict=True)] if self.low else low
        self.high = [max(pair) for pair in zip(self.high, high, strict=True)] if self.high else high


class PotreeOctree:
    """A cloud as an octree; `write_points` makes it, the other files are written after that.

    Args:
        parts: the cloud, all in one frame.
        offset_m: (3,) what the frame lacks to the coordinates of the file, which are of double precision.
        description: a sentence for `metadata.json`.
        report: receives the progress; may raise `Cancelled`.
    """

    def __init__(
        self,
        parts: Sequence[NumberedPart],
        *,
        offset_m: Sequence[float],
        description: str,
        report: Report | None = None,
    ) -> None:
        self._parts, self._report = parts, report
        self._offset = np.array(offset_m, dtype=np.float64)
        self._description = description
        self._intensity = SixteenBitIntensity([one.part.scan for one in parts])
        layers = parts[0].part.layers
        fields = [*_HEAD, ("sigma_px", "<f4"), *((name, one.values.dtype.str) for name, one in layers.items())]
        self._dtype = np.dtype(fields)
        self._words = {
            "intensity": self._intensity.words,
            "label": ", ".join(f"{label.value} {label.name.lower().replace('_', ' ')}" for label in Label),
            "photo_id": "number of the photograph in photographs.json; 0: none",
            "sigma_px": "standard deviation of the point's position in the photograph, px; NaN: not known",
            **{name: one.meaning for name, one in layers.items()},
        }
        self._ranges = {name: _Range() for name in self._dtype.names or ()}
        self._nodes: dict[tuple[int, int], _Node] = {}
        self._count = sum(int(np.count_nonzero(one.part.scan.valid)) for one in parts)
        self._done = 0

    def write_points(self, path: Path) -> None:
        """Write `octree.bin`.

        Raises:
            ExportError: if the file cannot be written.
        """
        self._measure()
        try:
            with tempfile.TemporaryFile(dir=path.parent) as spool, open(path, "wb") as file:
                starts, sizes, depths = self._sorted_into(spool)
                self._write_nodes(file, spool, starts, sizes, depths)
            sync_file(path)
        except OSError as error:
            raise cannot_write(path, error) from None

    def write_hierarchy(self, path: Path) -> None:
        """Write `hierarchy.bin`, in one piece; errors as `write_points`."""
        write_bytes(path, self._hierarchy())

    def write_metadata(self, path: Path) -> None:
        """Write `metadata.json`; errors as `write_points`."""
        write_document(path, self._metadata())

    # The cube and its cells

    def _measure(self) -> None:
        """Find the cube of the octree, and how finely coordinates are stored."""
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        for one in self._parts:
            for points in cloud_points(one.part):
                if len(points):
                    low, high = np.minimum(low, points.min(axis=0)), np.maximum(high, points.max(axis=0))
                self._progress(len(points), _SORTING)
        self._low = np.floor(low / _CORNER_ROUNDED_TO_M) * _CORNER_ROUNDED_TO_M
        self._side = max(float((high - self._low).max()), _SMALLEST_CUBE_M)
        self._scale = _SCALE_M if self._side / _SCALE_M < _LARGEST_INTEGER else _COARSER_SCALE_M
        self._side = (np.floor(self._side / self._scale) + 1) * self._scale

    def _stored(self, points: FloatArray) -> NDArray[np.int32]:
        """Return points (N, 3) of the frame as they are stored."""
        return np.asarray(np.rint((points - self._low) / self._scale), np.int32)

    def _keys(self, stored: NDArray[np.int32]) -> NDArray[np.int64]:
        """Return which cell of the finest grid holds each point: three bits a level, x y z, the coarsest first."""
        cells = (stored * (self._scale / self._side * 2.0**_KEY_DEPTH)).astype(np.int64)
        np.clip(cells, 0, 2**_KEY_DEPTH - 1, out=cells)
        return _spread(cells[:, 0]) << 2 | _spread(cells[:, 1]) << 1 | _spread(cells[:, 2])

    # Sorting into parts

    def _sorted_into(self, spool: IO[bytes]) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Write the points part by part; return where parts start, in points, their sizes, and depths of their cubes.

        The parts are cubes of the octree that have so few points that they fit into memory.
        """
        shift = 3 * (_KEY_DEPTH - _PART_DEPTH)
        counts = np.zeros(8**_PART_DEPTH, np.int64)
        for one in self._parts:
            for points in cloud_points(one.part):
                np.add.at(counts, self._keys(self._stored(points)) >> shift, 1)
                self._progress(len(points), _SORTING)
        cells, depths = _parts_of(counts)
        sums = np.concatenate([[0], np.cumsum(counts)])
        sizes = sums[np.append(cells[1:], len(counts))] - sums[cells]
        starts = sums[cells]
        filled = starts.copy()
        for one in self._parts:
            for rows in cloud_rows(one.part):
                records = self._records(rows, one.first_photo)
                of = np.searchsorted(cells, self._keys(records["position"]) >> shift, side="right") - 1
                order = np.argsort(of, kind="stable")
                records, of = records[order], of[order]
                for begin, end in _runs(of):
                    part = int(of[begin])
                    spool.seek(int(filled[part]) * self._dtype.itemsize)
                    spool.write(records[begin:end].tobytes())
                    filled[part] += end - begin
                self._progress(len(records), _SORTING)
        assert (filled == starts + sizes).all(), "the points are the same in every pass"
        return starts, sizes, depths

    def _records(self, rows: CloudRows, first_photo: int) -> NDArray[Any]:
        records = np.zeros(len(rows.points), self._dtype)
        records["position"] = self._stored(rows.points)
        records["intensity"] = self._intensity.written(rows.intensity)
        records["rgb"] = rows.color * _SIXTEEN_BITS
        records["label"] = rows.labels
        assert rows.photo is not None, "clouds for Potree are coloured by photographs with numbers"
        assert rows.sigma_px is not None
        shown = rows.photo + np.uint16(1)  # that of none becomes 0
        records["photo_id"] = np.where(shown > 0, shown + np.uint16(first_photo - 1), 0)
        records["sigma_px"] = rows.sigma_px
        for name, values in rows.layers.items():
            records[name] = values
        for name, found in self._ranges.items():
            found.add(records[name])
        return records

    # Nodes

    def _write_nodes(
        self,
        file: IO[bytes],
        spool: IO[bytes],
        starts: NDArray[np.int64],
        sizes: NDArray[np.int64],
        depths: NDArray[np.int64],
    ) -> None:
        above: dict[tuple[int, int], list[NDArray[Any]]] = {}  # of nodes that several parts share
        for start, size, depth in zip(starts.tolist(), sizes.tolist(), depths.tolist(), strict=True):
            if not size:
                continue
            spool.seek(start * self._dtype.itemsize)
            records = np.frombuffer(spool.read(size * self._dtype.itemsize), self._dtype)
            for level, codes, chosen in self._levels(records, depth):
                self._progress(len(chosen), "building the octree")
                for begin, end in _runs(codes):
                    node = (level, int(codes[begin]))
                    if level < depth:
                        above.setdefault(node, []).append(records[chosen[begin:end]])
                    else:
                        self._put(file, node, [records[chosen[begin:end]]])
        for node in list(above):
            self._put(file, node, above.pop(node))

    def _levels(self, records: NDArray[Any], depth: int) -> Iterator[tuple[int, NDArray[np.int64], NDArray[np.int64]]]:
        """Yield which points of a part stand in nodes of each level: the level, codes of nodes, ascending, and them."""
        keys = self._keys(records["position"])
        left = np.argsort(keys, kind="stable")
        # A point of each cell by the hash of its place: the first one would be that in its corner, and draw the grid.
        lots = ((keys.astype(np.uint64) * _HASH) >> np.uint64(33)).astype(np.int64) << 32
        for level in range(_MAX_DEPTH + 1):
            if not len(left):
                return
            codes = keys[left] >> 3 * (_KEY_DEPTH - level)
            stays = np.zeros(len(left), np.bool_)
            if level >= depth:
                for begin, end in _runs(codes):
                    stays[begin:end] = level == _MAX_DEPTH or end - begin <= _MAX_LEAF_POINTS
            goes_on = np.flatnonzero(~stays)
            if len(goes_on):
                cells = keys[left[goes_on]] >> 3 * (_KEY_DEPTH - level - _GRID_DEPTH)
                first = np.flatnonzero(np.append(True, cells[1:] != cells[:-1]))
                drawn = np.minimum.reduceat(lots[left[goes_on]] | goes_on, first) & 0xFFFFFFFF
                stays[drawn] = True
            yield level, codes[stays], left[stays]
            left = left[~stays]

    def _put(self, file: IO[bytes], node: tuple[int, int], pieces: Sequence[NDArray[Any]]) -> None:
        count = sum(len(piece) for piece in pieces)
        self._nodes[node] = _Node(file.tell(), count)
        for piece in pieces:
            file.write(piece.tobytes())

    def _hierarchy(self) -> bytes:
        """Return all nodes, breadth first: type, mask of children, number of points, first byte and bytes."""
        data = bytearray()
        for level, code in sorted(self._nodes):
            mask = sum(1 << k for k in range(8) if (level + 1, code << 3 | k) in self._nodes)
            node = self._nodes[level, code]
            data += bytes([0 if mask else 1, mask]) + node.points.to_bytes(4, "little")
            data += node.offset.to_bytes(8, "little")
            data += (node.points * self._dtype.itemsize).to_bytes(8, "little")
        return bytes(data)

    def _metadata(self) -> dict[str, Any]:
        depth = max(level for level, _ in self._nodes)
        corner = self._low + self._offset
        return {
            "version": "2.0",
            "name": "ladarreg",
            "description": self._description,
            "points": self._count,
            "projection": "",
            "hierarchy": {
                "firstChunkSize": len(self._nodes) * _NODE_BYTES,
                "stepSize": depth + 1,
                "depth": depth,
            },
            "offset": corner.tolist(),
            "scale": [self._scale] * 3,
            "spacing": self._side / 2**_GRID_DEPTH,
            "boundingBox": {"min": corner.tolist(), "max": (corner + self._side).tolist()},
            "encoding": "DEFAULT",
            "attributes": [self._attribute(name) for name in self._dtype.names or ()],
        }

    def _attribute(self, name: str) -> dict[str, Any]:
        dtype = self._dtype[name]
        elements = int(np.prod(dtype.shape)) if dtype.shape else 1
        found = self._ranges[name]
        low, high = np.array(found.low or [0.0] * elements), np.array(found.high or [0.0] * elements)
        if name == "position":
            low, high = (ends * self._scale + self._low + self._offset for ends in (low, high))
        return {
            "name": name,
            "description": self._words.get(name, ""),
            "size": dtype.itemsize,
            "numElements": elements,
            "elementSize": dtype.base.itemsize,
            "type": _TYPES[dtype.base.str],
            "min": low.tolist(),
            "max": high.tolist(),
        }

    def _progress(self, points: int, label: str) -> None:
        self._done += points
        if self._report is not None:
            self._report(Progress(self._done, _PASSES * self._count, label))


def _spread(values: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return 21 bits with two zeros after each."""
    spread = values & 0x1FFFFF
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        spread = (spread | spread << shift) & mask
    return np.asarray(spread)


def _runs(values: NDArray[Any]) -> list[tuple[int, int]]:
    """Return where equal values begin and end."""
    if not len(values):
        return []
    borders = np.flatnonzero(values[1:] != values[:-1]) + 1
    ends = [0, *borders.tolist(), len(values)]
    return list(itertools.pairwise(ends))


def _parts_of(counts: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the first cells of the cubes that the points are sorted into, ascending, and the depths of the cubes.

    Args:
        counts: (8**depth,) points of the cells of a grid.
    """
    sums = [counts]
    while len(sums[-1]) > 1:
        sums.append(sums[-1].reshape(-1, 8).sum(axis=1))
    sums.reverse()
    cells, depths = [], []
    waiting = [(0, 0)]
    while waiting:
        depth, code = waiting.pop()
        if sums[depth][code] <= _MAX_PART_POINTS or depth == _PART_DEPTH:
            cells.append(code << 3 * (_PART_DEPTH - depth))
            depths.append(depth)
        else:
            waiting += [(depth + 1, code << 3 | k) for k in reversed(range(8))]
    return np.array(cells, np.int64), np.array(depths, np.int64)
