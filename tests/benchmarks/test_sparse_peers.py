"""The peers for sparse lidars find an easy pose, and the report counts what they found."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from benchmarks.matching.edge_aligner import align_by_edges, cloud_edges
from benchmarks.matching.report import sections
from benchmarks.matching.sparse_peers import PEERS_SET, by_nid_simplex, seen_from
from benchmarks.matching.sparse_sets import off_by
from benchmarks.register import Row
from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid, look_along
from testing.scenes.painted_room import painted_room

LOW, HIGH = np.array([-1.0, -3.0, -1.5]), np.array([6.0, 2.5, 2.0])
CAMERA = Camera.from_focal(640, 480, 330.0)
TRUTH = Rigid.from_centre(look_along(np.array([1.0, 0.1, -0.05])), (0.2, 0.3, 0.1))


def _met(origin: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where rays (N, 3) from inside meet an empty room, and the number of the wall that they meet."""
    with np.errstate(divide="ignore"):
        along = (np.where(rays > 0, HIGH, LOW) - origin) / rays
    axis = along.argmin(axis=1)
    wall = 2 * axis + (np.take_along_axis(rays, axis[:, None], 1)[:, 0] > 0)
    return origin + along.min(axis=1)[:, None] * rays, wall


def room() -> tuple[np.ndarray, np.ndarray]:
    """Return the cloud of an empty room whose walls have one gray level each, and its photo."""
    azimuth, elevation = np.meshgrid(np.radians(np.arange(-74.9, 75, 0.25)), np.radians(np.arange(-39.9, 40, 0.25)))
    rays = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=-1
    ).reshape(-1, 3)
    points = _met(np.zeros(3), rays)[0] + np.random.default_rng(1).normal(0, 0.004, (len(rays), 3))
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    seen = np.column_stack([(u.ravel() - CAMERA.cx) / CAMERA.fx, (v.ravel() - CAMERA.cy) / CAMERA.fy, np.ones(u.size)])
    wall = _met(TRUTH.centre, seen @ TRUTH.rotation)[1]
    gray = np.array([0, 60, 100, 220, 30, 170], np.uint8)[wall].reshape(CAMERA.height, CAMERA.width)
    return points, cv2.cvtColor(cv2.GaussianBlur(gray, (0, 0), 0.7), cv2.COLOR_GRAY2RGB)


@pytest.mark.slow
def test_edges_of_a_cloud_are_where_its_walls_meet() -> None:
    edges = cloud_edges(room()[0])
    walls = np.stack([np.abs(edges.points - low) for low in (LOW, HIGH)]).min(axis=0)
    assert len(edges.points) > 300
    assert np.sort(walls, axis=1)[:, 1].max() < 0.03  # on two walls
    assert np.sort(np.abs(edges.directions), axis=1)[:, 2].min() > 0.99


@pytest.mark.long
def test_the_edge_aligner_finds_a_pose_one_degree_off() -> None:
    points, pixels = room()
    for seed in range(3):
        start = off_by(TRUTH, seed, degrees=1.0, metres=0.05)
        found = align_by_edges(points, pixels, CAMERA, start)
        assert found is not None
        assert np.degrees(found.angle_to(TRUTH)) < 0.35
        assert found.distance_to(TRUTH) < 0.05
    assert align_by_edges(points, np.full_like(pixels, 90), CAMERA, TRUTH) is None


@pytest.mark.long
def test_the_information_distance_finds_a_pose_one_degree_off() -> None:
    case = painted_room(seed=2)
    start = off_by(case.camera_from_scanner, 1, degrees=1.0, metres=0.02)
    assert case.error_px(start) > 5
    assert case.error_px(by_nid_simplex(case.scan, case.photo, start)) < 2.5


def test_points_behind_a_wall_are_hidden() -> None:
    y, z = (a.ravel() for a in np.meshgrid(np.linspace(-1, 1, 80), np.linspace(-1, 1, 80)))
    front, behind = (np.column_stack([np.full_like(y, x), s * y, s * z]) for x, s in ((2.0, 1.0), (4.0, 0.8)))
    seen = seen_from(np.vstack([front, behind]), np.array([0.0, 0.1, 0.0]))
    assert seen[: len(front)].mean() > 0.9
    assert seen[len(front) :].mean() < 0.05


def test_what_peers_found_is_counted_by_lidar() -> None:
    px = {"auto": (1.0, 2.0), "edges, after Yuan et al.": (5.0, math.inf), "NID, after Koide et al.": (7.0, 9.0)}
    rows = [
        Row(method, PEERS_SET, f"petals, {scene}", 1, True, error, 0.1, 20.0, 1.0)
        for method, errors in px.items()
        for scene, error in zip(("street", "courtyard"), errors, strict=True)
    ]
    rows.append(Row("auto", PEERS_SET, "real garage", 1, False, 7.9, 0.1, 20.0, 1.0))
    (section,) = sections(rows)
    text = str(section.tables)
    assert "2 of 2" in text
    assert "1 of 2" in text
    assert "0 of 2" in text
    assert "1 of 1" in text
