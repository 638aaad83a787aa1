"""Straight edges of the simulated rooms, as an operator would draw them: visible and legible in both panes."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.inspection.pictures import inspection_views, scan_picture
from ladarreg_core.simulate.case import SimulatedCase, case_world, simulate_case
from ladarreg_core.simulate.ray_cast import RayCaster
from ladarreg_core.simulate.worlds.world import World
from ladarreg_core.surface.perspective import View

MIN_PX, MAX_PX = 40.0, 400.0
MIN_STEP = 12.0
"""Gray levels by which the sides of a legible edge differ."""
TWIN_PX = 3.0
"""An edge closer than this to another one, in either pane, is not drawn: nobody could say which of them is meant."""
_SAMPLES = 81
_CLEARANCE_M = 0.004
_BORDER_PX = 12.0


@dataclass(frozen=True, eq=False)
class DrawnScene:
    """A simulated case and the edges in it that an operator would draw."""

    case: SimulatedCase
    view: View
    """The scan pane."""
    scan: NDArray[np.float64]
    """(N, 2, 2) true ends in the scan pane, px."""
    photo: NDArray[np.float64]
    """(N, 2, 2) true ends in the photograph, px."""


def drawn_scene(scene: str, seed: int, *, lines: int) -> DrawnScene:
    """Return a case with at most so many of its edges, chosen at random."""
    case = simulate_case(scene, seed=seed)
    view = inspection_views(case.scan)[0].view
    world = case_world(scene, seed=seed)
    scan, photo = _projected(case, view, _visible_parts(world, case))
    kept = _long(scan) & _long(photo)
    kept &= _inside(scan, view.intensity.shape) & _inside(photo, case.photo.pixels.shape[:2])
    scan, photo = scan[kept], photo[kept]
    scan, photo = _without_copies(scan, photo)
    gray_scan = scan_picture(view, "intensity")[..., 0].astype(np.float32)
    gray_photo = cv2.cvtColor(case.photo.pixels, cv2.COLOR_RGB2GRAY).astype(np.float32)
    legible = (_steps(gray_scan, scan) >= MIN_STEP) & (_steps(gray_photo, photo) >= MIN_STEP)
    alone = ~(_has_twin(scan) | _has_twin(photo))
    rows = np.flatnonzero(legible & alone)
    rng = np.random.default_rng([seed, 77])
    rows = rng.permutation(rows)[:lines]
    return DrawnScene(case, view, scan[rows], photo[rows])


def _visible_parts(world: World, case: SimulatedCase) -> NDArray[np.float64]:
    """Return the ends (N, 2, 3) of the longest part of each face's edge that scanner and camera both see, m."""
    edges = _edges_of_faces(world)
    s = np.linspace(0, 1, _SAMPLES)
    points = edges[:, :1] + s[:, None] * (edges[:, 1:] - edges[:, :1])  # (N, S, 3)
    caster = RayCaster(world.triangles)
    seen = np.ones(points.shape[:2], np.bool_)
    for eye in (np.zeros(3), case.camera_from_scanner.centre):
        away = eye - points
        starts = points + away * (_CLEARANCE_M / np.linalg.norm(away, axis=-1, keepdims=True))
        seen &= caster.sees(starts.reshape(-1, 3), eye).reshape(seen.shape)
    parts = []
    for row, visible in zip(points, seen, strict=True):
        ends = np.flatnonzero(np.diff(np.concatenate([[0], visible.astype(np.int8), [0]])))
        if not len(ends):
            continue
        starts_, stops = ends[::2], ends[1::2]
        best = int(np.argmax(stops - starts_))
        first, last = starts_[best] + 1, stops[best] - 2  # clear of what hides the rest
        if last > first:
            parts.append(row[[first, last]])
    return np.array(parts).reshape(-1, 2, 3)


def _edges_of_faces(world: World) -> NDArray[np.float64]:
    """Return the sides (N, 2, 3) of all flat faces, m."""
    triangles = world.triangles.astype(np.float64)
    flat = world.curve_of_face[world.face_of_triangle] < 0
    triangles = triangles[flat]
    # the diagonal of a face is its second side: (top left, bottom left, top right), (top right, bottom left, ...)
    half = len(triangles) // 2
    first, second = triangles[:half], triangles[half:]
    assert np.array_equal(first[:, 1], second[:, 1]), "the two halves of a face belong together"
    sides = [first[:, [0, 1]], first[:, [0, 2]], second[:, [0, 2]], second[:, [1, 2]]]
    return np.concatenate(sides)


def _projected(
    case: SimulatedCase, view: View, edges: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    scan = np.asarray(view.project(edges), dtype=np.float64)
    points = (case.camera_from_scanner @ edges.reshape(-1, 3)).reshape(edges.shape)
    photo = np.asarray(case.true_camera.project(points), dtype=np.float64)
    known = np.isfinite(scan).all(axis=(1, 2)) & np.isfinite(photo).all(axis=(1, 2))
    return scan[known], photo[known]


def _long(ends: FloatArray) -> NDArray[np.bool_]:
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1)
    return np.asarray((length >= MIN_PX) & (length <= MAX_PX))


def _inside(ends: FloatArray, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    low, high = _BORDER_PX, np.array([shape[1], shape[0]]) - 1 - _BORDER_PX
    return np.asarray(((ends >= low) & (ends <= high)).all(axis=(1, 2)))


def _without_copies(
    scan: NDArray[np.float64], photo: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Keep one of the sides that two faces share."""
    key = np.sort(np.rint(np.concatenate([scan, photo], axis=-1)).reshape(len(scan), -1), axis=-1)
    _, kept = np.unique(key, axis=0, return_index=True)
    kept = np.sort(kept)
    return scan[kept], photo[kept]


def _steps(gray: FloatArray, ends: FloatArray) -> NDArray[np.float64]:
    """Return by how much (N,) the two sides of edges differ, gray levels."""
    s = np.linspace(0.03, 0.97, 61)
    along = ends[:, :1] + s[:, None] * (ends[:, 1:] - ends[:, :1])
    normal = normals_of(ends)
    sides = []
    for sign in (-1, 1):
        total = np.zeros(along.shape[:2])
        for step in (1.5, 2.25, 3.0):
            at = (along + sign * step * normal[:, None]).astype(np.float32)
            total += np.asarray(cv2.remap(gray, at[..., 0], at[..., 1], cv2.INTER_LINEAR)) / 3
        sides.append(total)
    return np.asarray(np.abs(np.median(sides[1] - sides[0], axis=1)))


def normals_of(ends: FloatArray) -> NDArray[np.float64]:
    """Return the unit normals (N, 2) of lines (N, 2, 2)."""
    along = ends[:, 1] - ends[:, 0]
    along = along / np.linalg.norm(along, axis=-1, keepdims=True)
    return np.stack([-along[:, 1], along[:, 0]], axis=-1)


def _has_twin(ends: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return the edges (N,) that have a nearly parallel one beside them."""
    middle = ends.mean(axis=1)
    normal = normals_of(ends)
    parallel = np.abs(np.einsum("ni,mi->nm", normal, normal)) > np.cos(np.radians(12))
    # the middle of the shorter one lies beside the longer one
    offset = np.abs(np.einsum("nmi,mi->nm", middle[:, None] - middle[None], normal))
    along = np.stack([normal[:, 1], -normal[:, 0]], axis=-1)
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1)
    beside = np.abs(np.einsum("nmi,mi->nm", middle[:, None] - middle[None], along)) < length[None] / 2
    near = parallel & (offset < TWIN_PX) & (beside | beside.T)
    np.fill_diagonal(near, False)
    return np.asarray(near.any(axis=1))
