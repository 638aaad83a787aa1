"""Repair of lines drawn in the opposite direction, slid along their edge, or both; correct lines stay unchanged."""

from __future__ import annotations

import contextlib
from dataclasses import replace

import numpy as np
import pytest

from ladarreg_core.camera import Camera
from ladarreg_core.errors import DegenerateGeometryError
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid, rotation_from_rotvec
from ladarreg_core.matches import Matches
from ladarreg_core.pose.estimate import PoseOptions, solve_pose
from ladarreg_core.pose.estimators.bundle import States, adjust_ranges
from ladarreg_core.pose.estimators.measurements import Measurements
from ladarreg_core.pose.line_ends import RepairedEnds, repair_ends
from testing.scenes.pose_case import difference

SIGMA_PX, SIGMA_M = 1.0, 0.015
GATE = 9.21
LENSES = {
    "ideal": Camera.from_focal(768, 512, 974.0),
    "barrel": Camera(768, 512, 700.0, 700.0, 383.5, 255.5, (-0.28, 0.11, 1e-3, -7e-4, 0.0)),
}


def drawn(seed: int, camera: Camera, *, slid: int = 0, swapped: int = 0, both: int = 0) -> tuple[Matches, Rigid]:
    """Ten edges in all directions, up to the image border, with the pose; each defect affects lines of its own."""
    rng = np.random.default_rng([seed, 31])
    centre = np.array([0.1, 0.6, -0.2])
    pose = Rigid.from_centre(rotation_from_rotvec(0.05 * rng.normal(size=3)) @ CAMERA_AXES_FROM_SCANNER, centre)
    ends_px = rng.uniform([8, 8], [759, 503], (400, 2, 2))
    ends_px = ends_px[np.linalg.norm(ends_px[:, 1] - ends_px[:, 0], axis=1) > 250][:10]
    depth = rng.uniform(2.5, 6, (10, 2, 1))
    sight = camera.unproject(ends_px)
    points = pose.inverse @ (sight / sight[..., 2:] * depth)
    ranges = np.linalg.norm(points, axis=-1)
    # sliding along the edge in space follows its curve in the distorted image
    slides = np.array([[0.25], [-0.3]])[None] * (points[:, 1] - points[:, 0])[:, None]
    is_slid = (np.arange(10) < slid) | (np.arange(10) >= 10 - both)
    uv = camera.project(pose @ (points + np.where(is_slid[:, None, None], slides, 0)))
    lens_free = camera.without_distortion()
    tangents = np.empty((10, 2, 2))
    for k in (0, 1):
        ideal = lens_free.project(camera.unproject(uv))
        step = ideal[:, 1] - ideal[:, 0]
        step /= np.linalg.norm(step, axis=1, keepdims=True)
        ahead = camera.project(lens_free.unproject(ideal[:, k] + step))
        back = camera.project(lens_free.unproject(ideal[:, k] - step))
        tangents[:, k] = (ahead - back) / np.linalg.norm(ahead - back, axis=1, keepdims=True)
    uv = uv + SIGMA_PX * rng.normal(size=uv.shape)
    turned = ((np.arange(10) >= slid) & (np.arange(10) < slid + swapped)) | (np.arange(10) >= 10 - both)
    uv[turned], tangents[turned] = uv[turned][:, ::-1], -tangents[turned][:, ::-1]
    measured = ranges + SIGMA_M * rng.normal(size=ranges.shape)
    matches = Matches(
        (points / ranges[..., None]).reshape(-1, 3), measured.ravel(), uv.reshape(-1, 2),
        tuple(f"L{k}" for k in range(10) for _ in "ab"), np.tile([0.0, 1.0], 10),
        directions=tangents.reshape(-1, 2),
    )  # fmt: skip
    return matches, pose


def repaired(matches: Matches, pose: Rigid, camera: Camera) -> RepairedEnds:
    measured = Measurements.of(matches, camera, sigma_px=SIGMA_PX, sigma_range_m=SIGMA_M)
    state = States.of([pose], measured)
    inliers = adjust_ranges(measured, state)[1].s[0] <= GATE
    return repair_ends(matches, inliers, state, camera, gate=GATE, sigma_px=SIGMA_PX, sigma_range_m=SIGMA_M)


@pytest.mark.parametrize("lens", LENSES)
def test_each_kind_of_defect_is_recognised(lens: str) -> None:
    recognised: dict[str, list[int]] = {"slid": [], "swapped": [], "others": []}
    for seed in range(20):
        matches, pose = drawn(seed, LENSES[lens], slid=3, swapped=2, both=1)
        found = repaired(matches, pose, LENSES[lens])
        recognised["slid"].append(len({"L0", "L1", "L2", "L9"} & set(found.slid)))
        recognised["swapped"].append(len({"L3", "L4"} & set(found.swapped)))
        recognised["others"].append(len((set(found.slid) | set(found.swapped)) - {"L0", "L1", "L2", "L3", "L4", "L9"}))
    # the gate includes 99 % of single ends; a slid end beyond it across the line is an outlier
    assert np.mean(recognised["slid"]) > 4 * 0.94
    assert np.mean(recognised["swapped"]) > 2 * 0.94
    assert np.mean(recognised["others"]) < 4 * 0.06


def test_correct_lines_stay_unchanged() -> None:
    matches, pose = drawn(0, LENSES["ideal"])
    measured = Measurements.of(matches, LENSES["ideal"], sigma_px=SIGMA_PX, sigma_range_m=SIGMA_M)
    everything = np.ones(len(matches), np.bool_)
    found = repair_ends(
        matches, everything, States.of([pose], measured), LENSES["ideal"],
        gate=GATE, sigma_px=SIGMA_PX, sigma_range_m=SIGMA_M,
    )  # fmt: skip
    assert found.matches is matches
    assert found.describe() == ()


def test_a_line_of_another_edge_stays_an_outlier() -> None:
    for seed in range(10):
        matches, pose = drawn(seed, LENSES["ideal"])
        uv = np.array(matches.uv)
        uv[:2] += [[40.0, -35.0], [-30.0, 45.0]]  # rotated and shifted: no longer along its edge
        uv[:2] += 40 * np.array([-matches.directions[0, 1], matches.directions[0, 0]])  # type: ignore[index]
        found = repaired(replace(matches, uv=uv), pose, LENSES["ideal"])
        assert "L0" not in found.slid + found.swapped


def test_points_and_single_ends_are_not_repaired() -> None:
    matches, pose = drawn(1, LENSES["ideal"], slid=10)
    for keep in (matches.fractions == 0, matches.fractions == 1):
        half = matches.subset(keep)
        assert repaired(half, pose, LENSES["ideal"]).matches is half
    points = replace(matches, directions=np.zeros((20, 2)))
    assert repaired(points, pose, LENSES["ideal"]).matches is points
    assert len(repaired(matches.subset([]), pose, LENSES["ideal"]).matches) == 0


def test_a_repair_is_reported_and_changes_only_the_ends() -> None:
    matches, pose = drawn(2, LENSES["ideal"], slid=2, swapped=1)
    found = repaired(matches, pose, LENSES["ideal"])
    assert set(found.slid) >= {"L0", "L1"}
    assert found.swapped == ("L2",)
    assert found.describe()[0].startswith("Line L2 was drawn in the opposite direction in the photo")
    assert "not drawn between the same points" in found.describe()[1]
    changed = (found.matches.uv != matches.uv).any(axis=1)
    assert set(np.flatnonzero(changed)) == {4, 5}
    np.testing.assert_array_equal(found.matches.rays, matches.rays)
    np.testing.assert_array_equal(found.matches.ranges, matches.ranges)
    np.testing.assert_array_equal(found.matches.uv[[4, 5]], matches.uv[[5, 4]])


@pytest.mark.parametrize(
    ("lens", "defects"),
    [("ideal", {}), ("ideal", {"swapped": 2}), ("barrel", {"slid": 3})],
    ids=["correct", "swapped", "slid under distortion"],
)
def test_the_covariance_of_a_pose_from_lines_is_consistent(defects: dict[str, int], lens: str) -> None:
    squared = []
    for seed in range(60):
        matches, pose = drawn(seed, LENSES[lens], **defects)
        result = solve_pose(matches, LENSES[lens], PoseOptions(sigma_px=SIGMA_PX, sigma_range_m=SIGMA_M))
        step = difference(pose, result.camera_from_scanner)
        squared.append(float(step @ np.linalg.solve(result.covariance, step)))
    kept = np.sort(squared)[: int(0.98 * len(squared))]
    assert 0.85 < np.sqrt(np.mean(kept) / 6) < 1.15


@pytest.mark.parametrize("seed", range(5))
def test_parallel_lines_that_all_slid_are_not_accepted(seed: int) -> None:
    camera = LENSES["ideal"]
    rng = np.random.default_rng(seed)
    pose = Rigid.from_centre(CAMERA_AXES_FROM_SCANNER, [0.0, 0.5, 0.0])
    tops = np.column_stack([rng.uniform(3, 6, 9), rng.uniform(-1, 1, 9), np.full(9, 0.7)])
    points = np.stack([tops, tops * [1, 1, -1]], axis=1).reshape(-1, 3)
    ranges = np.linalg.norm(points, axis=1)
    uv = camera.project(pose @ points) + rng.normal(size=(18, 2))
    uv[:, 1] += rng.uniform(-60, 60, 18)
    matches = Matches(
        points / ranges[:, None], ranges, uv, tuple(str(k // 2) for k in range(18)), np.tile([0.0, 1.0], 9),
        directions=np.tile([0.0, 1.0], (18, 1)),
    )  # fmt: skip
    for initial in (None, pose):
        with contextlib.suppress(DegenerateGeometryError):
            assert not solve_pose(matches, camera, initial=initial).accepted
