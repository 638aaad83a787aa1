"""Which photograph every triangle of a mesh is textured with, and where its corners lie in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import CameraModel
from ladarreg_core.foundations.arrays import BoolArray, FloatArray, IntArray
from ladarreg_core.frames import Rigid
from ladarreg_core.surface.mesh.subdivision import (
    at_all_corners,
    at_any_corner,
    cut_edges,
    distinct,
    edge_ends,
    edge_keys,
    vertices_of,
    with_edge_of,
)

LASER = -1
"""Owner of a triangle that no photograph textures."""
_INSIDE_OVER_EDGE = 4 / 3  # a quadratic with zeros at the corners: its largest value inside over that at the midpoints
_BISECTIONS = 14
_MAX_ROUNDS = 9
_CELL_ERROR = 0.5  # of a texel of the laser intensity
_LONGEST_EDGE_PX = 2048.0
_AT_ONCE = 500_000
_POINTLESS = 1e-6
_SURELY = 1.001  # more than what rounding may take away from a bound


@dataclass(slots=True, eq=False)
class SeenBy:
    """What a camera sees of the vertices of a mesh."""

    camera: CameraModel
    """The camera."""
    camera_from_scanner: Rigid
    """Its pose."""
    seen: BoolArray
    """(N,) bool: vertices with the photograph's colour."""
    beside: BoolArray
    """(N,) bool: vertices that are only out of its frame."""

    @property
    def turn_px(self) -> float:
        """The width of a panorama of a full turn; 0: the picture does not wrap."""
        return self.camera.turn_px

    def project(self, points: FloatArray) -> NDArray[np.float64]:
        """Return the pixels (N, 2) of points of the scanner's frame; NaN where there are none."""
        result = np.empty((len(points), 2))
        for first in range(0, len(points), _AT_ONCE):
            some = slice(first, first + _AT_ONCE)
            result[some] = self.camera.project(self.camera_from_scanner @ points[some].astype(np.float64))
        return result

    def unwrapped(self, uv: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the pixels of triangles or edges (..., K, 2) on one side of the seam, that of their first corner."""
        if self.turn_px:
            uv = uv.copy()
            uv[..., 0] -= self.turn_px * np.rint((uv[..., 0] - uv[..., :1, 0]) / self.turn_px)
        return uv


class TexturedTriangles:
    """A mesh whose triangles are cut, assigned to photographs and divided; see `photo_model` for the order."""

    def __init__(
        self,
        vertices: FloatArray,
        normals: FloatArray,
        cells: IntArray,
        faces: IntArray,
        photos: Sequence[SeenBy],
        best: IntArray,
    ) -> None:
        """Args: arrays of the vertices (N, ...), triangles (F, 3), and the best photograph of each vertex (N,)."""
        self.vertices: FloatArray = vertices
        """(N, 3) float32, scanner frame, m."""
        self.normals: FloatArray = normals
        """(N, 3) float32, unit."""
        self.cells: FloatArray = cells.astype(np.float32)
        """(N, 2) float32: fractional (row, column)."""
        self.faces: IntArray = faces
        """(F, 3) int32."""
        self.owner: IntArray = np.full(len(faces), LASER, np.int16)
        """(F,) int16: index of the photograph, or `LASER`."""
        self._photos = list(photos)
        self._best: IntArray = best.astype(np.int16)
        self._changed: BoolArray = np.ones(len(faces), np.bool_)

    def keep(self, wanted: BoolArray) -> None:
        """Leave out the other triangles."""
        self.faces, self.owner = self.faces.compress(wanted, axis=0), self.owner[wanted]

    def cut_at_frames(self) -> None:
        """Cut edges that leave the frame of a photograph at its border."""
        for k, photo in enumerate(self._photos):
            touched = at_any_corner(photo.seen, self.faces) & at_any_corner(photo.beside, self.faces)
            rows = np.flatnonzero(touched)
            if not len(rows):
                continue
            keys = distinct(edge_keys(self.faces.take(rows, axis=0), len(self.vertices)))
            a, b = edge_ends(keys, len(self.vertices))
            leaves = (photo.seen[a] & photo.beside[b]) | (photo.seen[b] & photo.beside[a])
            keys, a, b = keys[leaves], a[leaves], b[leaves]
            inside, outside = np.where(photo.seen[a], a, b), np.where(photo.seen[a], b, a)
            share = self._share_inside(photo, inside, outside)
            useful = (share > _POINTLESS) & (share < 1 - _POINTLESS)
            keys, inside, outside, share = keys[useful], inside[useful], outside[useful], share[useful]
            self._cut(keys, inside, outside, share)
            first = len(self.vertices) - len(keys)
            photo.seen[first:] = True
            photo.beside[first:] = False
            self._best[first:] = k

    def _share_inside(self, photo: SeenBy, inside: IntArray, outside: IntArray) -> NDArray[np.float64]:
        """Return how far edges (E,) run within the frame, 0 to 1."""
        start = self.vertices.take(inside, axis=0)
        along = self.vertices.take(outside, axis=0) - start
        low, high = np.zeros(len(inside)), np.ones(len(inside))
        for _ in range(_BISECTIONS):
            middle = (low + high) / 2
            points = start + middle[:, None].astype(np.float32) * along
            within = photo.camera.contains(photo.project(points))
            low, high = np.where(within, middle, low), np.where(within, high, middle)
        return low

    def assign(self) -> None:
        """Give each triangle the photograph that is best at most of its corners, or any other that sees all of them."""
        self.owner = np.full(len(self.faces), LASER, np.int16)
        if len(self._photos) > 1:  # where regions of three meet, none of the best ones may
            for k in range(len(self._photos) - 1, -1, -1):
                self.owner[at_all_corners(self._photos[k].seen, self.faces)] = k
        a, b, c = (self._best.take(self.faces[:, k]) for k in range(3))
        agree = b == c
        majority_first = np.where(agree, b, a), np.where(agree, a, b), c
        for choice in reversed(majority_first):
            for k, photo in enumerate(self._photos):
                rows = np.flatnonzero(choice == k)
                self.owner[rows[at_all_corners(photo.seen, self.faces.take(rows, axis=0))]] = k

    def refine(self, largest_error_px: float, *, most_faces: int | None, on_grid: bool = False) -> float:
        """Divide triangles until the texture errs by at most so much within them.

        Args:
            largest_error_px: the error, px of the photograph.
            most_faces: a larger error is accepted if there would be more triangles; None: no limit.
            on_grid: a picture on the scan's grid is the texture of those with a photograph, too.

        Returns:
            The error that the division was made for, px. Triangles at a pole of a panorama may exceed it.
        """
        error = largest_error_px
        self._changed = np.ones(len(self.faces), np.bool_)
        for _ in range(_MAX_ROUNDS):
            new = self._edges_that_err(error / _INSIDE_OVER_EDGE, on_grid=on_grid)
            if not len(new):
                break
            if most_faces is not None and self._would_exceed(most_faces, new):
                error *= 2
                self._changed[:] = True
                continue
            first, second = edge_ends(new, len(self.vertices))
            self._cut(new, first, second, np.full(len(new), 0.5))
        self._drop_unplaced()
        return error

    def _would_exceed(self, most_faces: int, keys: IntArray) -> bool:
        """Return whether there would be more than so many triangles; each cut of one adds one."""
        room = most_faces - len(self.faces)
        if 2 * len(keys) <= room:  # an edge of the surface belongs to two triangles at most
            return False
        n = len(self.vertices)
        near = self.faces[with_edge_of(self.faces, keys, n)]
        return int(np.isin(edge_keys(near, n), keys).sum()) > room

    def _cut(self, keys: IntArray, start: IntArray, end: IntArray, share: NDArray[np.float64]) -> None:
        """Cut edges (E,), given by ascending keys, at a share of the way from `start` to `end`."""
        n = len(self.vertices)
        t = share[:, None].astype(np.float32)
        place = self.vertices[start] + t * (self.vertices[end] - self.vertices[start])
        normal = self.normals[start] + t * (self.normals[end] - self.normals[start])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.float32(1e-12))
        # In the scanner's view the point is nearer to the end that is farther away.
        near, far = (np.linalg.norm(self.vertices[at], axis=1) for at in (start, end))
        seen_share = (share * far / np.maximum((1 - share) * near + share * far, 1e-12))[:, None].astype(np.float32)
        cell = self.cells[start] + seen_share * (self.cells[end] - self.cells[start])
        self.vertices = np.concatenate([self.vertices, place.astype(np.float32)])
        self.normals = np.concatenate([self.normals, normal.astype(np.float32)])
        self.cells = np.concatenate([self.cells, cell])
        same = self._best[start] == self._best[end]
        self._best = np.concatenate([self._best, np.where(same, self._best[start], np.int16(LASER))])
        for photo in self._photos:
            photo.seen = np.concatenate([photo.seen, photo.seen[start] & photo.seen[end]])
            photo.beside = np.concatenate([photo.beside, photo.beside[start] & photo.beside[end]])
        self.faces, parent, self._changed = cut_edges(self.faces, keys, n)
        self.owner = self.owner[parent]

    def _edges_that_err(self, most_px: float, *, on_grid: bool) -> NDArray[np.int64]:
        """Return the keys of the edges of changed triangles whose midpoint errs by more than `most_px`, ascending."""
        n, found = len(self.vertices), [np.zeros(0, np.int64)]
        changed = np.flatnonzero(self._changed)
        for owner in range(LASER, len(self._photos)):
            faces = self.faces.take(changed[self.owner[changed] == owner], axis=0)
            for first in range(0, len(faces), _AT_ONCE):
                some = faces[first : first + _AT_ONCE]
                if owner == LASER or on_grid:
                    keys = distinct(edge_keys(some[self._may_err_on_grid(some)], n))
                    found.append(keys[self._errs_on_grid(*edge_ends(keys, n))])
                if owner != LASER:
                    photo = self._photos[owner]
                    keys = distinct(edge_keys(some[self._may_err_in(photo, some, most_px)], n))
                    found.append(keys[self._errs_in(photo, *edge_ends(keys, n), most_px)])
        return distinct(np.concatenate(found))

    def _may_err_on_grid(self, faces: IntArray) -> BoolArray:
        """Return which triangles (F, 3) may have an edge of `_errs_on_grid`; nearly all have not, by a cheap bound."""
        corners, used = faces.T.astype(np.intp), vertices_of(faces, len(self.vertices))
        distance = np.empty(len(self.vertices), np.float32)
        distance[used] = _length(self.vertices.take(used, axis=0))
        distance = distance.take(corners)
        low, high = distance.min(axis=0), distance.max(axis=0)
        extent = _length(_extent(self.cells, corners))
        return np.asarray(_SURELY * extent * (high - low) > 4 * _CELL_ERROR * low)

    def _may_err_in(self, photo: SeenBy, faces: IntArray, most_px: float) -> BoolArray:
        """Return which triangles (F, 3) may have an edge of `_errs_in` that is not short, by the boxes around them."""
        if photo.camera.as_panorama is not None:
            return np.ones(len(faces), np.bool_)
        corners, used = faces.T.astype(np.intp), vertices_of(faces, len(self.vertices))
        points = self.vertices.take(used, axis=0)
        uv, distance = np.empty((len(self.vertices), 2)), np.empty(len(self.vertices), np.float32)
        uv[used] = photo.project(points)
        distance[used] = _length(points - photo.camera_from_scanner.centre.astype(np.float32))
        length = _SURELY * _length(_extent(uv, corners))
        nearest = distance.take(corners).min(axis=0)
        short = length * _length(_extent(self.vertices, corners)) < most_px * nearest
        return np.asarray(~(short & (length <= _LONGEST_EDGE_PX)))

    def _errs_on_grid(self, a: IntArray, b: IntArray) -> BoolArray:
        near, far = (np.linalg.norm(self.vertices[at], axis=1) for at in (a, b))
        length = np.linalg.norm(self.cells[b] - self.cells[a], axis=1)
        errs: BoolArray = length * np.abs(far - near) > 2 * _CELL_ERROR * (near + far)
        return errs

    def _errs_in(self, photo: SeenBy, a: IntArray, b: IntArray, most_px: float) -> BoolArray:
        uv = photo.unwrapped(np.stack([photo.project(self.vertices[at]) for at in (a, b)], axis=1))
        length = np.linalg.norm(uv[:, 1] - uv[:, 0], axis=1)
        errs: BoolArray = ~(length <= _LONGEST_EDGE_PX)
        # An edge errs by its bend in the picture and by the change of depth along it: short ones need no closer look.
        centre = photo.camera_from_scanner.centre.astype(np.float32)
        near, far = (np.linalg.norm(self.vertices[at] - centre, axis=1) for at in (a, b))
        with np.errstate(divide="ignore", invalid="ignore"):
            along = np.linalg.norm(self.vertices[b] - self.vertices[a], axis=1) / np.minimum(near, far)
            short = length * along < most_px
        if photo.camera.as_panorama is not None:  # bends without bound near its poles
            short[:] = False
        suspect = np.flatnonzero(~errs & ~short)
        middle = (self.vertices[a[suspect]] + self.vertices[b[suspect]]) / np.float32(2)
        at = photo.project(middle)
        linear = uv[suspect].mean(axis=1)
        difference = photo.camera.difference(at, linear)
        errs[suspect] = ~(np.linalg.norm(difference, axis=1) <= most_px)
        return np.asarray(errs)

    def _drop_unplaced(self) -> None:
        """Give triangles to the laser that have a corner without a place in their photograph."""
        for k, photo in enumerate(self._photos):
            rows = np.flatnonzero(self.owner == k)
            used = vertices_of(self.faces.take(rows, axis=0), len(self.vertices))
            lost = used[~np.isfinite(photo.project(self.vertices.take(used, axis=0))).all(axis=1)]
            if len(lost):
                self.owner[rows[np.isin(self.faces[rows], lost).any(axis=1)]] = LASER

    def textured(self, owner: int) -> tuple[IntArray, NDArray[np.float64], IntArray]:
        """Return the triangles of an owner with vertices of their own.

        Returns:
            vertex (M,), indices of `vertices`; pixels (M, 2) in the photograph, or on the scan's grid for `LASER`; and
            faces (F, 3) int32, indices of these. Triangles across the seam of a panorama have pixels beyond its border.
        """
        faces = self.faces.compress(self.owner == owner, axis=0)
        vertex = vertices_of(faces, len(self.vertices))
        index = np.empty(len(self.vertices), np.int32)
        index[vertex] = np.arange(len(vertex), dtype=np.int32)
        faces = index.take(faces)
        if owner == LASER:
            return vertex, self.cells.take(vertex, axis=0)[:, ::-1].astype(np.float64), faces
        photo = self._photos[owner]
        uv = photo.project(self.vertices.take(vertex, axis=0))
        if not photo.turn_px or not len(faces):
            width, height = photo.camera.size
            # The midpoint of an edge along a curved border of the picture may lie beyond it by a fraction of a pixel.
            return vertex, np.clip(uv, 0, (width - 1, height - 1)), faces
        corners = photo.unwrapped(uv[faces])
        turns = np.rint((corners[..., 0] - uv[faces, 0]) / photo.turn_px).astype(np.int64)
        numbered = faces.astype(np.int64) * 3 + turns + 1
        unique, inverse = np.unique(numbered, return_inverse=True)
        at, turn = unique // 3, unique % 3 - 1
        pixels = uv[at] + np.stack([turn * photo.turn_px, np.zeros(len(at))], axis=-1)
        return vertex[at], pixels, inverse.reshape(faces.shape).astype(np.int32)


def _extent(values: FloatArray, corners: IntArray) -> FloatArray:
    """Return the sides (F, K) of the boxes around the values (N, K) at the corners (3, F) of triangles."""
    taken = values.take(corners, axis=0)
    return np.asarray(taken.max(axis=0) - taken.min(axis=0))


def _length(vectors: FloatArray) -> FloatArray:
    """Return the lengths (N,) of vectors (N, K)."""
    return np.asarray(np.sqrt(np.einsum("nk,nk->n", vectors, vectors)))
