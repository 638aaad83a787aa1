"""A textured model as a tree of tiles, coarse to fine: an octree whose leaves are the model itself.

A triangle belongs to the cube that its centroid is in. Cubes are divided until what they contain is small enough for
one file. The tile of a cube that is divided is a simplification of everything in it: the vertices within each cell of a
grid move to one of them. The grid is the same for all cubes of a size, so tiles beside each other meet without cracks,
and no point moves by more than the diagonal of its cell, which is the error of the tile.

Source: Rossignac and Borrel, Multi-resolution 3D approximations for rendering complex scenes (1993).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.foundations.arrays import FloatArray, IntArray
from ladarreg_core.surface.mesh.model_part import ModelPart

_CELLS = 64
"""Cells of the grid along the edge of a cube."""
_MAX_DEPTH = 14  # three indices of cells fit into 63 bits
_LEAF_FACES = 40_000
_LEAF_PX = 2_500_000
_LEAF_SIDE_PX = 2048
_COARSE_PX = 600_000
_MIN_SIDE_PX = 8


@dataclass(frozen=True, slots=True, eq=False)
class SizedPart:
    """A part of a tile, and how large its texture is to be."""

    part: ModelPart
    """Triangles with their rectangle of a picture."""
    longest_px: int
    """Longer side that the texture is reduced to, if it is larger."""


@dataclass(frozen=True, slots=True, eq=False)
class ModelTile:
    """A node of the tree."""

    depth: int
    """0: the root."""
    low: NDArray[np.float64]
    """(3,) least coordinates of its own and its children's points, scanner frame, m."""
    high: NDArray[np.float64]
    """(3,) largest ones."""
    error_m: float
    """How far its surface is from the model's at most, m; 0: it is the model."""
    rows: IntArray
    """(F,) the triangles that it stands for, counted through all parts."""
    children: tuple[ModelTile, ...]
    """The tiles that replace it; together they stand for the same triangles."""

    @property
    def tiles(self) -> tuple[ModelTile, ...]:
        """This tile and all below it, by depth."""
        found, level = [], [self]
        while level:
            found += level
            level = [child for tile in level for child in tile.children]
        return tuple(found)


class ModelTree:
    """The tree of a model.

    Args:
        parts: the parts of the model, at least one triangle together.
        leaf_faces: most triangles of a leaf.
        leaf_px: most pixels of its textures.
    """

    def __init__(self, parts: Sequence[ModelPart], *, leaf_faces: int = _LEAF_FACES, leaf_px: int = _LEAF_PX) -> None:
        self._parts = tuple(parts)
        self._leaf_faces, self._leaf_px = leaf_faces, leaf_px
        self._first_face = np.cumsum([0, *(len(part.faces) for part in self._parts)])
        corners = [part.vertices[part.faces] for part in self._parts]
        self._low = np.concatenate([each.min(axis=1) for each in corners])
        self._high = np.concatenate([each.max(axis=1) for each in corners])
        self._centre = np.concatenate([each.mean(axis=1, dtype=np.float64) for each in corners])
        del corners
        low, high = (np.asarray(each, np.float64) for each in (self._low.min(axis=0), self._high.max(axis=0)))
        self._size = float((high - low).max()) or 1.0
        self._origin = (low + high - self._size) / 2
        self._simplified: tuple[int, tuple[ModelPart, ...]] | None = None
        self.root = self._tile(np.arange(len(self._low)), 0, self._origin)

    def content(self, tile: ModelTile) -> list[SizedPart]:
        """Return what is drawn for a tile; tiles of the same depth one after the other are faster."""
        if not tile.children:
            whole = [
                each
                for part, rows in self._by_part(self._parts, tile.rows)
                for each in _subset(part, rows).divided(_LEAF_SIDE_PX)
            ]
            return [SizedPart(part, _LEAF_SIDE_PX) for part in whole]
        coarse = []
        for part, rows in self._by_part(self._at_depth(tile.depth), tile.rows):
            rows = _without_repeats(part.faces, rows)
            if len(rows):
                coarse.append(_subset(part, rows))
        if not coarse:  # all of it is within one cell
            coarse = [_subset(part, rows) for part, rows in self._by_part(self._parts, tile.rows)]
        share = min(1.0, np.sqrt(_COARSE_PX / sum(part.tile.width * part.tile.height for part in coarse)))
        return [
            SizedPart(part, max(_MIN_SIDE_PX, int(share * max(part.tile.width, part.tile.height)))) for part in coarse
        ]

    def _tile(self, rows: IntArray, depth: int, corner: FloatArray) -> ModelTile:
        size = self._size / 2**depth
        low, high = self._low[rows].min(axis=0).astype(np.float64), self._high[rows].max(axis=0).astype(np.float64)
        if depth == _MAX_DEPTH or self._fits(rows):
            return ModelTile(depth, low, high, 0.0, rows, ())
        beyond = self._centre[rows] >= corner + size / 2
        octant = beyond @ (1, 2, 4)
        children = []
        for k in np.unique(octant):
            below = corner + size / 2 * np.array([k & 1, k >> 1 & 1, k >> 2 & 1])
            children.append(self._tile(rows[octant == k], depth + 1, below))
        # Vertices move within their cells.
        cell = size / _CELLS
        low = self._origin + np.floor((low - self._origin) / cell) * cell
        high = self._origin + (np.floor((high - self._origin) / cell) + 1) * cell
        for child in children:
            low, high = np.minimum(low, child.low), np.maximum(high, child.high)
        return ModelTile(depth, low, high, float(np.sqrt(3) * cell), rows, tuple(children))

    def _fits(self, rows: IntArray) -> bool:
        if len(rows) > self._leaf_faces:
            return False
        area = 0.0
        for part, mine in self._by_part(self._parts, rows):
            corners = part.pixels[part.faces[mine]].reshape(-1, 2)
            area += float(np.prod(corners.max(axis=0) - corners.min(axis=0) + 1))
        return area <= self._leaf_px or len(rows) == 1

    def _by_part(self, parts: Sequence[ModelPart], rows: IntArray) -> list[tuple[ModelPart, IntArray]]:
        """Return the parts with triangles of some rows, ascending, and which of their triangles these are."""
        starts = np.searchsorted(rows, self._first_face)
        return [
            (part, rows[first:last] - offset)
            for part, first, last, offset in zip(parts, starts, starts[1:], self._first_face, strict=False)
            if last > first
        ]

    def _at_depth(self, depth: int) -> tuple[ModelPart, ...]:
        """Return the parts with their vertices moved; triangles keep their rows, collapsed ones have equal corners."""
        if self._simplified is not None and self._simplified[0] == depth:
            return self._simplified[1]
        self._simplified = None
        cell = self._size / 2**depth / _CELLS
        places = np.concatenate([part.vertices for part in self._parts])
        owner = np.repeat(np.arange(len(self._parts)), [len(part.vertices) for part in self._parts])
        index = np.floor((places - self._origin) / cell).astype(np.int64)
        _, cluster = np.unique((index[:, 0] << 42) + (index[:, 1] << 21) + index[:, 2], return_inverse=True)
        count = np.bincount(cluster)
        mean = np.stack([np.bincount(cluster, places[:, k]) / count for k in range(3)], axis=-1)
        # The vertex nearest to the mean of its cell stands for all; in each part, the nearest to that one gives the
        # place in the picture, so that parts keep their textures and meet where they met.
        best = _first_of(cluster, np.square(places - mean[cluster]).sum(axis=1))
        stands = places[best][cluster]
        pair = cluster * len(self._parts) + owner
        _, numbered = np.unique(pair, return_inverse=True)
        nearest = _first_of(numbered, np.square(places - stands).sum(axis=1))[numbered]
        moved, first = [], 0
        for part in self._parts:
            mine = slice(first, first + len(part.vertices))
            to = (nearest[mine] - first).astype(np.int32)
            moved.append(replace(part, vertices=stands[mine], faces=to[part.faces]))
            first = mine.stop
        self._simplified = depth, tuple(moved)
        return self._simplified[1]


def _first_of(group: IntArray, distance: FloatArray) -> IntArray:
    """Return the member (N indices) of least distance of each group, 0 to G - 1: (G,)."""
    order = np.lexsort((distance, group))
    return order[np.searchsorted(group[order], np.arange(int(group.max()) + 1))]


def _without_repeats(faces: IntArray, rows: IntArray) -> IntArray:
    """Return the rows of triangles with three different corners, one of each three corners."""
    corners = np.sort(faces[rows], axis=1)
    whole = (corners[:, 0] < corners[:, 1]) & (corners[:, 1] < corners[:, 2])
    rows, corners = rows[whole], corners[whole]
    _, first = np.unique(corners, axis=0, return_index=True)
    return rows[np.sort(first)]


def _subset(part: ModelPart, rows: IntArray) -> ModelPart:
    wanted = np.zeros(len(part.faces), np.bool_)
    wanted[rows] = True
    return part.subset(wanted)
