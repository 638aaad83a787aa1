"""Places that two photographs of the sample survey both show, from the true poses and the laser's surface."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from itertools import combinations

import numpy as np

import ladarreg_core as lr
from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid
from ladarreg_core.simulate.sample import sample_survey_folder
from ladarreg_core.survey.least_squares.problem import Matrix
from ladarreg_core.survey.ties.ties import laser_points
from testing.scenes.survey_set import sample_cameras


@dataclass(frozen=True, slots=True, eq=False)
class SharedPlaces:
    """Two photographs of the sample survey, and pixels at which both show the same place of the first scan."""

    scan: lr.Scan
    names: tuple[str, str]
    cameras: tuple[Camera, Camera]
    poses: tuple[Rigid, Rigid]
    uv: Matrix
    """(N, 2, 2)."""


@cache
def shared_places() -> SharedPlaces:
    """Return the two photographs of the sample survey that share most of the first scan."""
    folder = sample_survey_folder()
    truth = json.loads((folder / "truth.json").read_text())
    scan = lr.read_scan(folder / "station1.npz")
    names = [name for name in truth["camera_from_world"] if name.startswith("IMG")]
    cameras, poses = {}, {}
    for number, name in enumerate(names):  # of two cameras in turn
        cameras[name] = sample_cameras()[number % 2]
        poses[name] = Rigid.from_matrix(truth["camera_from_world"][name])
    best: SharedPlaces | None = None
    for one, other in combinations(names, 2):
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
