"""Peers for sparse lidars, from the same rough guesses: an edge aligner, and the information distance after Koide."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import get_args

import cv2
import numpy as np
from scipy.spatial import ConvexHull, cKDTree

import ladarreg_core as lr
from benchmarks.matching.edge_aligner import align_by_edges
from benchmarks.matching.nid import NidPair
from benchmarks.matching.sparse_sets import error_px, off_by, outdoor_case, real_cases
from benchmarks.register import Row, timed
from ladarreg_core.foundations.arrays import BoolArray, FloatArray
from ladarreg_core.frames import Rigid
from ladarreg_core.simulate.robot_lidar import LidarName
from ladarreg_core.simulate.worlds.outdoors import OUTDOORS

OURS = "auto"
PEERS_SET = "sparse peers"
_NID_POINTS = 20_000
_STEPS = ((0.05, 0.15), (0.02, 0.06), (0.01, 0.04))  # rad, m: of the first simplex, before each culling
_FLIPPED = 1000.0
_SHADE_NEIGHBOURS = 12
_LIGHT = np.array([1.0, 2.0, 3.0]) / np.sqrt(14)


def by_edges(scan: lr.Scan, photo: lr.Photo, guess: Rigid) -> Rigid | None:
    """Align edges of the cloud with those of the photo, see `edge_aligner`."""
    return align_by_edges(scan.points[scan.valid].astype(float), photo.pixels, photo.camera, guess)


def by_nid_simplex(scan: lr.Scan, photo: lr.Photo, guess: Rigid) -> Rigid:
    """Minimise the information distance of intensity and gray level by Nelder-Mead, hidden points removed.

    A scan without intensity is compared by its shading: the light on its surfaces from above and aside.

    Source: Koide et al., 'General, single-shot, target-less, and automatic LiDAR-camera extrinsic calibration toolbox',
        ICRA 2023. Its first guess, from matches of a network, is not part of this.
    """
    valid = scan.valid
    points = scan.points[valid].astype(float)
    chosen = np.random.default_rng(3).permutation(len(points))[:_NID_POINTS]
    values = scan.intensity[valid][chosen].astype(float) if scan.has_intensity else _shading(points, points[chosen])
    gray = cv2.cvtColor(photo.pixels, cv2.COLOR_RGB2GRAY).astype(np.float32)
    pair = NidPair(points[chosen], values, gray, photo.camera)  # type: ignore[arg-type]
    pose = guess
    for step_rad, step_m in _STEPS:
        visible = seen_from(pair.points, pose.centre)
        pose = pair.refine(pose, visible=visible, step_rad=step_rad, step_m=step_m)[0]
    return pose


SPARSE_PEERS: dict[str, Callable[[lr.Scan, lr.Photo, Rigid], Rigid | None]] = {
    "edges, after Yuan et al.": by_edges,
    "NID, after Koide et al.": by_nid_simplex,
}
"""Ways to register a photo of a sparse lidar from a rough guess; they have no verdict."""


def seen_from(points: FloatArray, centre: FloatArray) -> BoolArray:
    """Return which points (N, 3) are not hidden by others from a centre (3,).

    Source: Katz, Tal, Basri, 'Direct visibility of point sets', 2007: points are reflected at a sphere around the
        centre, and those on the convex hull are seen.
    """
    offset = points - centre
    distance = np.linalg.norm(offset, axis=1, keepdims=True).clip(1e-6)
    radius = _FLIPPED * float(np.percentile(distance, 99.5))
    flipped = offset + 2 * (radius - distance) * offset / distance
    corners = ConvexHull(np.vstack([flipped, np.zeros(3)])).vertices
    seen = np.zeros(len(points) + 1, np.bool_)
    seen[corners] = True
    return seen[:-1]


def _shading(every: FloatArray, points: FloatArray) -> FloatArray:
    """Return how much light falls on the surfaces at points (N, 3) of a cloud, turned towards the scanner."""
    near = every[cKDTree(every).query(points, k=_SHADE_NEIGHBOURS)[1]]
    offsets = near - near.mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(offsets.transpose(0, 2, 1) @ offsets)[1][:, :, 0]
    normals *= -np.sign((normals * points).sum(1, keepdims=True))
    return np.asarray(normals @ _LIGHT)


def peer_rows(seeds: range) -> Iterator[Row]:
    """Every sparse lidar and place, and the real captures, by every method from the same rough guesses."""
    for what, seed, scan, photo, truth in _cases(seeds):
        guess = off_by(truth, seed)
        result, seconds, steps = timed(scan, photo, initial=guess)
        found = result.camera_from_scanner
        yield _row(OURS, what, seed, found, seconds, scan, photo, truth, accepted=result.accepted, steps=steps)
        for name, find in SPARSE_PEERS.items():
            begin = time.process_time()
            pose = find(scan, photo, guess)
            seconds = time.process_time() - begin
            yield _row(name, what, seed, pose, seconds, scan, photo, truth, accepted=pose is not None)


def _cases(seeds: range) -> Iterator[tuple[str, int, lr.Scan, lr.Photo, Rigid]]:
    for lidar in get_args(LidarName):
        for scene in OUTDOORS:
            for seed in seeds:
                case = outdoor_case(scene, lidar, seed)
                yield f"{lidar}, {scene}", seed, case.scan, case.photo, case.camera_from_scanner
    for name, scan, photo, truth in real_cases():
        for seed in seeds:
            yield f"real {name}", seed, scan, photo, truth


def _row(
    method: str, what: str, seed: int, pose: Rigid | None, seconds: float, scan: lr.Scan, photo: lr.Photo,
    truth: Rigid, *, accepted: bool, steps: dict[str, float] | None = None,
) -> Row:  # fmt: skip
    px = float("inf") if pose is None else error_px(scan, pose, photo.camera, truth)
    degrees, mm = (
        (np.nan, np.nan) if pose is None else (np.degrees(pose.angle_to(truth)), 1e3 * pose.distance_to(truth))
    )
    return Row(method, PEERS_SET, what, seed, accepted, px, float(degrees), float(mm), seconds, steps=steps or {})
