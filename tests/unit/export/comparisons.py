"""Comparisons made by hand: stages that are off the true pose by known amounts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import get_args

import numpy as np

from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.matches import Matches
from ladarreg_core.photo import Photo
from ladarreg_core.pose.result import describe_pose
from ladarreg_core.registration.comparison import Column, Comparison
from ladarreg_core.results.registration import PoseResult, Stage, StageName
from ladarreg_core.scan import Scan
from ladarreg_core.surface.texture.registered_texture import texture_scan

STAGES: tuple[StageName, ...] = get_args(StageName)
OFF = {"linear": 1.5, "constrained_linear": 0.6, "simplex": 0.25, "simplex_outliers_removed": 0.08, "default": 0.0}
NOTE = "The linear solution refuses: 28 matches lie within 2 cm of one plane."


def seen_matches(scan: Scan, photo: Photo, truth: Rigid, count: int, rng: np.random.Generator) -> Matches:
    """Return true matches with some noise, every fifth of them wrong."""
    points = scan.points[scan.valid].astype(float)
    uv = photo.camera.project(truth @ points)
    chosen = rng.choice(np.flatnonzero(photo.camera.contains(uv)), count)
    noise = rng.normal(size=(count, 2)) * 0.4
    noise[::5] *= 40
    return Matches(scan.rays[scan.valid][chosen], scan.ranges[scan.valid][chosen], uv[chosen] + noise)


def stage_result(
    scan: Scan, photo: Photo, truth: Rigid, *, off: float, accepted: bool, count: int = 30, seed: int = 0
) -> PoseResult:
    """Return the pose `off` degrees and 5 `off` centimetres from the truth, described on matches."""
    rng = np.random.default_rng(seed)
    axis, way = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    pose = Rigid.from_centre(
        rotation_from_rotvec(np.deg2rad(off) * axis) @ truth.rotation, truth.centre + 0.05 * off * way
    )
    result = describe_pose(
        pose,
        seen_matches(scan, photo, truth, count, rng),
        np.arange(count) % 5 != 0,
        photo.camera,
        sigma_px=0.5,
        sigma_range_m=0.01,
        covariance=np.diag([1e-7] * 3 + [1e-6] * 3),
    )
    reason = "412 of 436 windows agree." if accepted else "The residuals do not fit the noise."
    return replace(result, accepted=accepted, evidence="image" if accepted else "none", reasons=(reason,))


def comparison_of(
    scan: Scan,
    photo: Photo,
    truth: Rigid,
    *,
    stages: Sequence[StageName] = STAGES,
    accepted: Sequence[str] = ("default",),
    no_pose: Sequence[str] = (),
    off: Mapping[str, float] = OFF,
    cautions: tuple[str, ...] = (),
) -> Comparison:
    columns = []
    for number, name in enumerate(stages):
        if name in no_pose:
            columns.append(Column(stage=Stage(name=name, result=None, note=NOTE), texture=None, seconds=0.01))
            continue
        result = stage_result(scan, photo, truth, off=off[name], accepted=name in accepted, seed=number)
        texture = texture_scan(scan, photo, result.camera_from_scanner, covariance=result.covariance)
        columns.append(Column(stage=Stage(name=name, result=result), texture=texture, seconds=0.2 * number))
    return Comparison(columns=tuple(columns), cautions=cautions, seed=3)
