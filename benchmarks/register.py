"""Measurement of one registration: its true error, its stated uncertainty, and the time of each step.

The times are the processor's, all threads together: what one core would need.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import cv2
import numpy as np

import ladarreg_core as lr
from benchmarks.matching.peers import THESIS, by_nid, by_sift, by_sift_on_gradients
from ladarreg_core.camera import Camera
from ladarreg_core.registration.register import RegisterOptions
from ladarreg_core.simulate import SimulatedCase


@dataclass(frozen=True)
class Row:
    """One case by one method."""

    method: str
    set_name: str
    what: str
    """The scene, or the names of a combined case."""
    seed: int
    accepted: bool
    error_px: float
    """Median displacement of the visible cells by pose and camera together; infinite where there is no true pose."""
    error_deg: float
    error_mm: float
    seconds: float
    sigmas: float = float("nan")
    """RMS error of the pose in its own standard deviations."""
    focal_percent: float = float("nan")
    k1: float = float("nan")
    """Error of the estimated camera."""
    steps: dict[str, float] = field(default_factory=dict)
    """Wall-clock seconds by step."""


def errors(case: SimulatedCase, pose: lr.Rigid, camera: Camera | None = None) -> tuple[float, float, float]:
    """Return the median displacement of visible cells (px), the angle (deg) and the distance (mm) from the truth.

    Args:
        case: with the truth.
        pose: what was found.
        camera: the camera that was found; None: the true one.
    """
    points = case.scan.points[case.scan.valid][::29].astype(float)
    true_camera, truth = case.true_camera, case.camera_from_scanner
    true = true_camera.project(truth @ points)
    off = np.hypot(*(true - (camera or true_camera).project(pose @ points))[true_camera.contains(true)].T)
    seen = off[np.isfinite(off)]
    px = float(np.median(seen)) if len(seen) else float("nan")
    return px, float(np.degrees(pose.angle_to(truth))), 1e3 * pose.distance_to(truth)


def timed(
    scan: lr.Scan, photo: lr.Photo, *, initial: lr.Rigid | None = None, options: RegisterOptions | None = None
) -> tuple[lr.Registration, float, dict[str, float]]:
    """Register; also return processor seconds, and wall-clock seconds by step."""
    begin = time.process_time()
    result = lr.register(scan, photo, initial=initial, options=options)
    seconds = time.process_time() - begin
    steps: dict[str, float] = {}
    for step in result.steps:
        steps[step.name] = steps.get(step.name, 0.0) + step.seconds
    return result, seconds, steps


def by_default(
    case: SimulatedCase,
    set_name: str,
    what: str,
    seed: int,
    *,
    initial: lr.Rigid | None = None,
    options: RegisterOptions | None = None,
) -> Row:
    """Register by the default method."""
    result, seconds, steps = timed(case.scan, case.photo, initial=initial, options=options)
    camera = result.camera
    px, deg, mm = errors(case, result.camera_from_scanner, camera)
    truth = case.camera_from_scanner
    w = cv2.Rodrigues(truth.rotation @ result.camera_from_scanner.rotation.T)[0][:, 0]
    d = np.concatenate([w, truth.centre - result.camera_from_scanner.centre])
    return Row(
        "auto", set_name, what, seed, result.accepted, px, deg, mm, seconds,
        sigmas=float(np.sqrt(d @ np.linalg.solve(result.covariance, d) / 6)),
        focal_percent=100 * abs(camera.focal_px / case.true_camera.focal_px - 1),
        k1=abs((camera.distortion or (0.0,))[0] - (case.true_camera.distortion or (0.0,))[0]), steps=steps,
    )  # fmt: skip


QUICK_PEERS: dict[str, Callable[[SimulatedCase], lr.Rigid | None]] = {
    "SIFT + RANSAC": by_sift,
    "SIFT on gradients": by_sift_on_gradients,
}
"""Peers run on every case."""
SLOW_PEERS: dict[str, Callable[[SimulatedCase], lr.Rigid | None]] = {"NID alone": by_nid}
"""Peers run on some cases, like both forms of the thesis's chain."""
METHODS = ("auto", *THESIS, *SLOW_PEERS, *QUICK_PEERS)
"""All methods, in the order of the tables."""


def by_peers(case: SimulatedCase, set_name: str, scene: str, seed: int, *, slow_too: bool) -> Iterator[Row]:
    """Register by the other methods; those without a verdict accept every pose."""
    for name, options in THESIS.items() if slow_too else ():
        begin = time.process_time()
        result = lr.register(case.scan, case.photo, method="thesis", options=RegisterOptions(thesis=options))
        found = result.camera_from_scanner if len(result.matches) else None
        yield _of_peer(name, case, found, set_name, scene, seed, begin, accepted=result.accepted)
    for name, find in {**QUICK_PEERS, **(SLOW_PEERS if slow_too else {})}.items():
        begin = time.process_time()
        pose = find(case)
        yield _of_peer(name, case, pose, set_name, scene, seed, begin, accepted=pose is not None)


def _of_peer(
    name: str, case: SimulatedCase, pose: lr.Rigid | None, set_name: str, scene: str, seed: int, begin: float,
    *, accepted: bool,
) -> Row:  # fmt: skip
    seconds = time.process_time() - begin
    px, deg, mm = errors(case, pose) if pose else (np.nan, np.nan, np.nan)
    return Row(name, set_name, scene, seed, accepted, px, deg, mm, seconds)
