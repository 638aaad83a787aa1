"""Places and lines that photographs of the sample survey share, from the true poses and the laser's surface."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations

import numpy as np

import ladarreg_core as lr
from ladarreg_core.camera import Camera, CameraModel
from ladarreg_core.foundations.arrays import BoolArray
from ladarreg_core.frames import Rigid
from ladarreg_core.picks.lines import line_on_scan
from ladarreg_core.simulate.sample import sample_survey_folder
from ladarreg_core.survey.least_squares.problem import Matrix
from ladarreg_core.survey.ties.ties import laser_points
from testing.scenes.survey_set import sample_cameras

_MIN_LINE_PX = 80.0
_MIN_APART = float(np.sin(np.radians(10)))  # the planes in which photographs see a line


@dataclass(frozen=True, slots=True, eq=False)
class SharedPlaces:
    """Two photographs of the sample survey, and pixels at which both show the same place of the first scan."""

    scan: lr.Scan
    names: tuple[str, str]
    cameras: tuple[Camera, Camera]
    poses: tuple[Rigid, Rigid]
    uv: Matrix
    """(N, 2, 2)."""


@dataclass(frozen=True, slots=True, eq=False)
class SharedLines:
    """Three photographs of the sample survey, and two places in each of the same straight lines."""

    names: tuple[str, ...]
    cameras: tuple[Camera, ...]
    poses: tuple[Rigid, ...]
    uv: Matrix
    """(N, 3, 2, 2); other places of a line in each photograph."""
    xyz: Matrix
    """(N, 2, 3) two places of it on the surface of the first scan, m."""


def _photographs() -> tuple[lr.Scan, dict[str, Camera], dict[str, Rigid]]:
    folder = sample_survey_folder()
    truth = json.loads((folder / "truth.json").read_text())["camera_from_world"]
    names = [name for name in truth if name.startswith("IMG") and truth[name] is not None]
    poses = {name: Rigid.from_matrix(truth[name]) for name in names}
    cameras = {name: sample_cameras()[number % 2] for number, name in enumerate(names)}  # of two cameras in turn
    return lr.read_scan(folder / "station1.npz"), cameras, poses


@cache
def shared_lines(count: int = 6) -> SharedLines:
    """Return lines between places of the first scan that the three photographs show which share most of it."""
    scan, cameras, poses = _photographs()
    points = scan.points[scan.valid][::40].astype(np.float64)
    visible = {name: shown_by(scan, points, cameras[name], pose) for name, pose in poses.items()}
    names = max(combinations(poses, 3), key=lambda three: int(np.all([visible[one] for one in three], axis=0).sum()))
    common = points[np.all([visible[one] for one in names], axis=0)]
    own_cameras, own_poses = tuple(cameras[one] for one in names), tuple(poses[one] for one in names)
    rng, lines = np.random.default_rng(5), []
    while len(lines) < count:
        found = line_between(common, own_cameras, own_poses, rng)
        if found is not None:
            lines.append(found)
    xyz, uv = (np.array(each) for each in zip(*lines, strict=True))
    return SharedLines(names, own_cameras, own_poses, uv, xyz)


@cache
def lines_on_scan(count: int = 4) -> SharedLines:
    """Return lines on the surface of the first scan, which it shows all along, in the photograph that shows most of it.

    The two places in the photograph are the ends.
    """
    scan, cameras, poses = _photographs()
    points = scan.points[scan.valid][::40].astype(np.float64)
    visible = {name: shown_by(scan, points, cameras[name], pose) for name, pose in poses.items()}
    name = max(visible, key=lambda one: int(visible[one].sum()))
    shown, rng = points[visible[name]], np.random.default_rng(3)
    found: list[tuple[Matrix, Matrix]] = []
    while len(found) < count:
        first = shown[rng.integers(len(shown))]
        apart = np.linalg.norm(shown - first, axis=1)
        near = shown[(apart > 0.5) & (apart < 2.0)]
        if not len(near):
            continue
        ends = np.array([first, near[rng.integers(len(near))]])
        uv = cameras[name].project(poses[name] @ ends)
        if np.linalg.norm(uv[1] - uv[0]) > _MIN_LINE_PX and _is_straight(scan, ends):
            found.append((ends, uv[None]))
    xyz, places = (np.array(each) for each in zip(*found, strict=True))
    return SharedLines((name,), (cameras[name],), (poses[name],), places, xyz)


def _is_straight(scan: lr.Scan, ends: Matrix) -> bool:
    """Return whether a scan shows a line (2, 3) between two of its points as a straight edge or a line on a wall."""
    edge = line_on_scan(scan, ends / np.linalg.norm(ends, axis=1, keepdims=True))
    there = None if edge is None else edge.rays * edge.ranges[:, None]
    return there is not None and bool(np.linalg.norm(there - ends, axis=1).max() < 0.02)


def shown_by(scan: lr.Scan, points: Matrix, camera: CameraModel, pose: Rigid) -> BoolArray:
    """Return which points (N, 3) of a scan a photograph shows, not near its border."""
    shown = camera.project(pose @ points)
    there = laser_points(scan, camera, pose, np.nan_to_num(shown)).xyz
    return np.asarray(camera.contains(shown, border=5) & (np.linalg.norm(there - points, axis=1) < 0.02))


def line_between(
    common: Matrix, cameras: Sequence[CameraModel], poses: Sequence[Rigid], rng: np.random.Generator
) -> tuple[Matrix, Matrix] | None:
    """Return a line between two points of all (N, 3), drawn by lot: its ends (2, 3), and two places (n, 2, 2) of it.

    These are others in each photograph. None: it is short in one, or all see it in nearly the same plane.
    """
    first, second = common[rng.choice(len(common), 2, replace=False)]
    at = rng.uniform([0.0, 0.75], [0.25, 1.0], (len(poses), 2))
    uv = np.array([
        camera.project(pose @ (first + own[:, None] * (second - first)))
        for camera, pose, own in zip(cameras, poses, at, strict=True)
    ])  # fmt: skip
    normals = [np.cross(first - pose.centre, second - first) for pose in poses]
    apart = [
        np.linalg.norm(np.cross(a, b)) / np.linalg.norm(a) / np.linalg.norm(b) for a, b in combinations(normals, 2)
    ]
    long = np.linalg.norm(uv[:, 1] - uv[:, 0], axis=1).min() > _MIN_LINE_PX
    return (np.array([first, second]), uv) if long and max(apart) > _MIN_APART else None


@cache
def shared_places() -> SharedPlaces:
    """Return the two photographs of the sample survey that share most of the first scan."""
    scan, cameras, poses = _photographs()
    best: SharedPlaces | None = None
    for one, other in combinations(poses, 2):
        camera = cameras[one]
        grid = np.stack(np.meshgrid(np.arange(40, camera.width - 40, 25), np.arange(40, camera.height - 40, 25)), -1)
        uv = grid.reshape(-1, 2).astype(np.float64)
        here = laser_points(scan, camera, poses[one], uv).xyz.astype(np.float64)
        there = cameras[other].project(poses[other] @ here)
        inside = cameras[other].contains(there, border=20)
        seen = laser_points(scan, cameras[other], poses[other], np.nan_to_num(there)).xyz
        shared = inside & (np.linalg.norm(seen - here, axis=1) < 0.02)
        if best is None or shared.sum() > len(best.uv):
            both = np.stack([uv, there], axis=1)[shared]
            best = SharedPlaces(scan, (one, other), (camera, cameras[other]), (poses[one], poses[other]), both)
    assert best is not None
    assert len(best.uv) > 60
    return best
