"""Rows of `benchmarks.speed` on the pose estimator, against poselib, and on the simplex's objective."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

import ladarreg_core as lr
from benchmarks.speed.clock import Measure, compared, duration, in_turn
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, ThesisParameters
from ladarreg_core.matches import Matches
from ladarreg_core.thesis.estimators.stereo import StereoPairs, stereo_cost

_CAMERA = lr.Camera.from_focal(768, 512, 974.0)
_POSE = lr.Rigid.from_centre(CAMERA_AXES_FROM_SCANNER, (0.1, -0.4, 0.1))
_LENS = {"model": "PINHOLE", "width": 768, "height": 512, "params": [974.0, 974.0, _CAMERA.cx, _CAMERA.cy]}
_SIZES = (50, 200, 1000, 2000)
_CASES, _TIMES = 12, 5
_MISMATCHES = 0.3
_STATED = {"sigma_px": 1.0, "sigma_range_m": 0.015}
_EVALUATIONS = 20_000
_Case = tuple[NDArray[np.float64], NDArray[np.float64]]


def _case(count: int, seed: int) -> _Case:
    """Return points (N, 3), scanner frame, and their pixels (N, 2), some of them wrong."""
    rng = np.random.default_rng([count, seed])
    points = np.column_stack([rng.uniform(2, 6, count), rng.uniform(-1, 1, count), rng.uniform(-0.8, 0.8, count)])
    uv = _CAMERA.project(_POSE @ points) + rng.normal(0, 1, (count, 2))
    wrong = int(_MISMATCHES * count)
    uv[:wrong] = rng.uniform(0, 1, (wrong, 2)) * _CAMERA.size
    away = points / np.linalg.norm(points, axis=1, keepdims=True)
    return points + away * rng.normal(0, _STATED["sigma_range_m"], (count, 1)), uv


def _ours(case: _Case, stated: dict[str, Any]) -> object:
    points, uv = case
    ranges = np.linalg.norm(points, axis=1)
    return lr.estimate_pose(points / ranges[:, None], ranges, uv, _CAMERA, **stated)


def _by_poselib(case: _Case) -> object:
    import poselib

    points, uv = case
    return poselib.estimate_absolute_pose(uv, points, _LENS, {"max_reproj_error": 5.0})


def pose(*, quick: bool) -> Iterator[str]:
    """Poses with covariance and verdict against poselib's bundle-adjusted pose alone; growth with the matches."""
    times: dict[str, list[float]] = {"noise stated": [], "noise not stated": []}
    for count in _SIZES:
        cases = [_case(count, seed) for seed in range(3 if quick else _CASES)]
        for name, stated in (("noise stated", _STATED), ("noise not stated", {})):
            took = []
            for case in cases:
                own, peer = in_turn([partial(_ours, case, stated), partial(_by_poselib, case)], times=_TIMES)
                took.append((own, peer))
            times[name].append(float(np.median([own.processor for own, _ in took])))
            goal = "<= 1.5" if count == 200 else "< 1" if count == 2000 else "-"
            yield compared(f"pose, {count} matches, {name}", took, "poselib", goal=goal)
    for name, took_of in times.items():
        slope = np.polyfit(np.log(_SIZES), np.log(np.maximum(took_of, 1e-6)), 1)[0]
        yield f"pose, {name}: processor time grows as matches ^ {slope:.2f}"


def simplex(*, quick: bool) -> Iterator[str]:
    """Evaluations of the simplex's objective, Eq 2.21, per second."""
    for count in (20, 100, 500):
        points, uv = _case(count, 0)
        ranges = np.linalg.norm(points, axis=1)
        pairs = StereoPairs.of(Matches(points / ranges[:, None], ranges, uv), _CAMERA)
        cost = stereo_cost(pairs.subset(pairs.usable))
        p = ThesisParameters.from_pose(_POSE)
        start = np.array([p.Tx, p.Ty, p.Tz, p.alpha, p.beta, p.gamma])
        moved = start + np.random.default_rng(0).normal(0, 0.01, (64, 6))

        def evaluate(cost: Any = cost, moved: NDArray[np.float64] = moved) -> None:
            for k in range(_EVALUATIONS):
                cost(moved[k % 64])

        best = min(duration(evaluate).processor for _ in range(2 if quick else 5))
        yield f"simplex, {count} matches: {_EVALUATIONS / best:,.0f} evaluations a second (asked: >= 100,000)"


POSE_ROWS: dict[str, Measure] = {"pose": pose, "simplex": simplex}
"""Rows by name."""
