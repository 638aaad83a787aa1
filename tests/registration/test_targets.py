"""Spheres found in scans, and the pose of a scanner by them."""

import json
from dataclasses import replace

import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.errors import DegenerateGeometryError, OptionError
from ladarreg_core.frames import rotvec_from_rotation
from ladarreg_core.registration.stations.target_search import _apart, _candidates
from ladarreg_core.simulate.stations import scan_stations, station_room, upright_pose, with_plates, with_spheres

_RADIUS, _NOISE = 0.0725, 0.002
_NAMES = ("A", "B", "C", "D", "E", "F")
_WORLD = np.array(
    [[4.0, 1.0, 0.5], [4.5, -1.2, 0.2], [3.5, 0.2, -0.5], [5.0, 2.0, -0.2], [4.2, -2.2, 0.7], [3.2, -0.8, -0.3]]
)


def _empty_scan(wall_m: float = 6.0) -> lr.Scan:
    azimuth, elevation = np.radians(np.arange(40, -40, -0.15)), np.radians(np.arange(16, -16, -0.15))
    cosines = np.cos(elevation)[:, None] * np.cos(azimuth)
    noise = np.random.default_rng(1).normal(0, _NOISE, cosines.shape)
    return lr.Scan.from_grid(ranges=wall_m / cosines + noise, azimuth_rad=azimuth, elevation_rad=elevation)


def _pick(scan: lr.Scan, center: np.ndarray, beside_m: float = 0.0) -> tuple[int, int]:
    toward = center + np.array([0, beside_m, 0])
    at = np.argmax(scan.rays @ (toward / np.linalg.norm(toward)))
    row, column = np.unravel_index(at, scan.shape)
    return int(row), int(column)


@pytest.fixture(scope="module")
def pose() -> lr.Rigid:
    return lr.Rigid.from_rotvec([0.02, -0.01, 0.15], [0.3, -0.4, 0.1])


@pytest.fixture(scope="module")
def targets(pose: lr.Rigid) -> dict[str, lr.SurveyTarget]:
    own = pose.inverse @ _WORLD
    scan = with_spheres(_empty_scan(), own, _RADIUS, noise_m=_NOISE)
    return {
        name: lr.fit_target(scan, _pick(scan, center), radius_m=_RADIUS)
        for name, center in zip(_NAMES, own, strict=True)
    }


def test_centers_of_spheres_are_right_and_their_covariances_true(targets, pose):
    squares = []
    for name, center in zip(_NAMES, pose.inverse @ _WORLD, strict=True):
        error = targets[name].center - center
        assert np.linalg.norm(error) < 0.75 * _NOISE
        assert targets[name].rms_m == pytest.approx(_NOISE, rel=0.35)
        squares.append(error @ np.linalg.solve(targets[name].covariance, error) / 3)
    assert 0.2 < np.mean(squares) < 2.5


@pytest.mark.parametrize("beside_m", [-0.05, 0.03, 0.055])
def test_the_pick_need_not_be_in_the_middle(beside_m):
    center = np.array([3.0, 0.4, 0.1])
    scan = with_spheres(_empty_scan(), center[None], _RADIUS, noise_m=_NOISE, seed=3)
    middle = lr.fit_target(scan, _pick(scan, center), radius_m=_RADIUS)
    beside = lr.fit_target(scan, _pick(scan, center, beside_m), radius_m=_RADIUS)
    assert np.allclose(beside.center, middle.center, atol=1e-4)


def test_a_sphere_close_to_a_wall_is_not_drawn_to_it():
    center = np.array([3.0, 0.4, 0.1])
    scan = with_spheres(_empty_scan(3.1), center[None], _RADIUS, noise_m=_NOISE, seed=4)
    assert np.linalg.norm(lr.fit_target(scan, _pick(scan, center), radius_m=_RADIUS).center - center) < 0.75 * _NOISE


def test_a_wall_is_no_sphere():
    with pytest.raises(DegenerateGeometryError, match="pick a cell on the sphere"):
        lr.fit_target(_empty_scan(), (100, 200), radius_m=_RADIUS)


@pytest.mark.parametrize("radius_m", [0.05, 0.1])
def test_a_wrong_radius_is_refused(radius_m):
    center = np.array([3.0, 0.4, 0.1])
    scan = with_spheres(_empty_scan(), center[None], _RADIUS, noise_m=_NOISE)
    with pytest.raises(DegenerateGeometryError, match="radius"):
        lr.fit_target(scan, _pick(scan, center), radius_m=radius_m)


@pytest.mark.parametrize("pick", [(-1, 3), (3, 99_999), (1.5, 2), (1,), None])
def test_a_pick_outside_of_the_scan_is_refused(pick):
    with pytest.raises(OptionError):
        lr.fit_target(_empty_scan(), pick, radius_m=_RADIUS)


@pytest.mark.parametrize("radius_m", [0, -1, float("nan"), "x"])
def test_an_impossible_radius_is_refused(radius_m):
    with pytest.raises(OptionError):
        lr.fit_target(_empty_scan(), (5, 5), radius_m=radius_m)


def _distance(found: lr.TargetRegistration, pose: lr.Rigid) -> float:
    turn = rotvec_from_rotation(pose.rotation @ found.world_from_scanner.rotation.T)
    error = np.concatenate([turn, pose.translation - found.world_from_scanner.translation])
    return float(np.sqrt(error @ np.linalg.solve(found.covariance, error) / 6))


def test_the_pose_by_surveyed_coordinates(targets, pose):
    found = lr.register_targets(targets, dict(zip(_NAMES, _WORLD, strict=True)))
    assert found.world_from_scanner.distance_to(pose) < 0.002
    assert _distance(found, pose) < 2.2
    assert found.left_out == ()
    assert found.dof == 12
    assert json.loads(json.dumps(found.as_fields()))["targets"][0]["name"] == "A"


def test_the_pose_of_a_scan_relative_to_another(targets, pose):
    other = lr.Rigid.from_rotvec([0, 0, -0.2], [-0.2, 0.3, 0])
    own = other.inverse @ _WORLD
    scan = with_spheres(_empty_scan(), own, _RADIUS, noise_m=_NOISE, seed=9)
    second = {
        name: lr.fit_target(scan, _pick(scan, center), radius_m=_RADIUS)
        for name, center in zip(_NAMES, own, strict=True)
    }
    found = lr.register_targets(second, targets)
    assert _distance(found, pose.inverse @ other) < 2.2


def test_a_moved_target_is_left_out(targets, pose):
    coordinates = dict(zip(_NAMES, _WORLD, strict=True)) | {"C": _WORLD[2] + [0, 0.03, 0]}
    found = lr.register_targets(targets, coordinates)
    assert found.left_out == ("C",)
    assert found.residuals_m["C"] == pytest.approx([0, 0.03, 0], abs=0.004)
    assert _distance(found, pose) < 2.2


def test_exchanged_names_are_left_out(targets, pose):
    coordinates = dict(zip(_NAMES, _WORLD, strict=True)) | {"A": _WORLD[1], "B": _WORLD[0]}
    found = lr.register_targets(targets, coordinates)
    assert found.left_out == ("A", "B")
    assert _distance(found, pose) < 2.2


def test_contradictions_that_cannot_be_resolved_are_refused(targets):
    three = {name: targets[name] for name in "ABC"}
    coordinates = dict(zip(_NAMES, _WORLD, strict=True)) | {"C": _WORLD[2] + [0, 0.05, 0.3]}
    with pytest.raises(DegenerateGeometryError, match="cannot be decided"):
        lr.register_targets(three, coordinates)


def test_too_few_or_collinear_targets_are_refused(targets):
    coordinates = dict(zip(_NAMES, _WORLD, strict=True))
    with pytest.raises(DegenerateGeometryError, match="2 of 2 targets"):
        lr.register_targets({name: targets[name] for name in "AB"}, coordinates)
    line = {
        name: lr.SurveyTarget(np.array([k, 1.0, 0.0]), 1e-6 * np.eye(3), _RADIUS, _NOISE, 50, 0)
        for k, name in enumerate("ABC")
    }
    with pytest.raises(DegenerateGeometryError, match="on a line"):
        lr.register_targets(line, {name: target.center for name, target in line.items()})


def test_coordinates_that_are_none_are_refused(targets):
    coordinates = dict(zip(_NAMES, _WORLD, strict=True)) | {"B": [1, np.nan, 2]}
    with pytest.raises(OptionError, match="target B"):
        lr.register_targets(targets, coordinates)


def _plate_scan(side: float = 0.15, *, seed: int = 0) -> tuple[lr.Scan, np.ndarray, np.ndarray]:
    """Three flat targets, turned and tilted, before a wall."""
    azimuth = np.radians(np.arange(30, -30, -0.08))
    elevation = np.radians(np.arange(8, -8, -0.08))
    walls = np.full((len(elevation), len(azimuth)), 9.0)
    walls += np.random.default_rng(seed).normal(0, _NOISE, walls.shape)
    centers = np.array([[4.0, 1.0, 0.2], [3.5, -0.8, -0.1], [5.0, 0.1, 0.3]])
    facing = np.array([[0.3, 0.1, 0.2], [1.2, -0.3, -0.2], [-0.4, 0.0, 0.4]])
    scan = with_plates(
        lr.Scan.from_grid(ranges=walls, azimuth_rad=azimuth, elevation_rad=elevation), centers, facing, side,
        noise_m=_NOISE, seed=seed,
    )  # fmt: skip
    return scan, centers, facing


@pytest.mark.slow
def test_the_middle_of_a_flat_target_is_found_far_below_the_spacing_of_the_cells() -> None:
    squares = []
    for seed in range(5):
        scan, centers, _ = _plate_scan(seed=seed)
        for center in centers:
            found = lr.fit_target(scan, _pick(scan, center, beside_m=0.03), side_m=0.15)
            off = found.center - center
            assert np.linalg.norm(off) < 0.0015, "cells are 5 to 7 mm apart"
            assert found.radius_m is None
            assert found.side_m == 0.15
            squares.append(off @ np.linalg.solve(found.covariance, off) / 3)
    assert 0.4 < np.sqrt(np.mean(squares)) < 1.5


def test_spheres_and_flat_targets_place_a_scanner_together(pose: lr.Rigid) -> None:
    scan, centers, _ = _plate_scan()
    ball = np.array([4.2, -1.6, 0.1])
    scan = with_spheres(scan, ball[None], _RADIUS, noise_m=_NOISE)
    found = {f"P{k}": lr.fit_target(scan, _pick(scan, center), side_m=0.15) for k, center in enumerate(centers)}
    found["S"] = lr.fit_target(scan, _pick(scan, ball), radius_m=_RADIUS)
    surveyed = {f"P{k}": pose @ center for k, center in enumerate(centers)} | {"S": pose @ ball}
    placed = lr.register_targets(found, surveyed, sigma_m=0.001)
    assert placed.world_from_scanner.distance_to(pose) < 0.004


def test_what_is_no_flat_target_is_refused() -> None:
    scan, centers, _ = _plate_scan()
    wall = _pick(scan, np.array([4.0, 0.5, -0.3]))
    rng = np.random.default_rng(4)
    for light in (scan.intensity, rng.normal(1, 0.1, scan.shape).astype(np.float32)):  # one grey, and noise
        with pytest.raises(DegenerateGeometryError, match="no black-and-white target"):
            lr.fit_target(replace(scan, intensity=light), wall, side_m=0.15)
    with pytest.raises(DegenerateGeometryError, match=r"at least 40 are needed|fewer than 40 cells"):
        lr.fit_target(scan, _pick(scan, centers[2]), side_m=0.02)
    for sizes in ({}, {"radius_m": 0.1, "side_m": 0.1}):
        with pytest.raises(OptionError, match="either its radius or its side"):
            lr.fit_target(scan, wall, **sizes)


def test_an_edge_alone_is_no_flat_target() -> None:
    scan, centers, _ = _plate_scan(side=0.6)
    row, column = _pick(scan, centers[1])
    quarter = _pick(scan, centers[1] + np.array([0.0, 0.0, 0.17]))
    assert (row, column) != quarter
    with pytest.raises(DegenerateGeometryError, match="four quadrants explain"):
        lr.fit_target(scan, quarter, side_m=0.12)


def _room_with(centers: np.ndarray, seed: int) -> lr.Scan:
    """A furnished room, all around, with spheres."""
    pytest.importorskip("embreex")
    room = station_room("office", seed)
    (scan,) = scan_stations(room, [upright_pose(np.zeros(3), 0.4)], seed=seed, step_deg=0.2)
    return with_spheres(scan, centers, _RADIUS, noise_m=_NOISE, seed=seed)


def _around(seed: int, count: int = 6) -> np.ndarray:
    rng = np.random.default_rng(seed)
    bearings = rng.uniform(0, 2 * np.pi / count, count) * 0.8 + np.arange(count) * 2 * np.pi / count
    heights = rng.uniform(-0.15, 0.15, count)
    away = np.column_stack([np.cos(bearings), np.sin(bearings), heights])
    return rng.uniform(0.9, 1.2, (count, 1)) * away


@pytest.mark.slow
@pytest.mark.parametrize("seed", [11, 12])
def test_spheres_are_found_in_a_room_and_named(seed):
    centers = _around(seed)
    scan = _room_with(centers, seed)
    found = lr.find_targets(scan, radius_m=_RADIUS)
    away = np.linalg.norm(np.array([one.center for one in found])[:, None] - centers, axis=-1)
    assert (away.min(axis=0) < 0.003).all()
    pose = lr.Rigid.from_rotvec([0.0, 0.0, 2.0], [100.0, 50.0, 3.0])
    world = dict(zip(_NAMES, pose @ centers, strict=True))
    named = lr.name_targets(found, world)
    assert all(
        np.linalg.norm(named[name].center - center) < 0.003 for name, center in zip(_NAMES, centers, strict=True)
    )
    assert np.linalg.norm(lr.register_targets(named, world).world_from_scanner.translation - pose.translation) < 0.003
    # a sphere that was moved is still named, and then left out
    moved = world | {"B": world["B"] + [0.0, 0.03, 0.0]}
    assert lr.register_targets(lr.name_targets(found, moved), moved).left_out == ("B",)
    # the targets of another scan are coordinates as well
    other = {f"T{k}": one for k, one in enumerate(found)}
    assert set(lr.name_targets(found, other).values()) <= set(found)


def test_targets_at_even_distances_are_not_named_at_random():
    square = np.array([[2.0, 2.0, 0.0], [2.0, -2.0, 0.0], [-2.0, -2.0, 0.0], [-2.0, 2.0, 0.0]])
    found = [_target(center) for center in square]
    with pytest.raises(DegenerateGeometryError, match="others would fit as well"):
        lr.name_targets(found, dict(zip("ABCD", square, strict=True)))
    # the control: one of them elsewhere
    uneven = square + np.array([[0, 0, 0], [0, 0, 0], [0, 0, 0], [0.7, 0.2, 0.1]])
    named = lr.name_targets([_target(center) for center in uneven[::-1]], dict(zip("ABCD", uneven, strict=True)))
    assert all(np.allclose(named[name].center, center) for name, center in zip("ABCD", uneven, strict=True))


def test_the_mirror_image_of_the_coordinates_is_not_taken():
    found = [_target(center) for center in _WORLD]
    mirrored = dict(zip(_NAMES, _WORLD * [1, -1, 1], strict=True))
    with pytest.raises(DegenerateGeometryError):
        lr.name_targets(found, mirrored)


@pytest.mark.slow
def test_three_of_very_many_fit_by_chance():
    rng = np.random.default_rng(5)
    found = [_target(center) for center in rng.uniform(-4, 4, (90, 3))]
    names = dict(zip([f"T{k}" for k in range(40)], rng.uniform(-4, 4, (40, 3)), strict=True))
    with pytest.raises(DegenerateGeometryError, match="fit"):
        lr.name_targets(found, names)


def test_too_many_targets_are_refused_before_they_are_compared():
    places = np.random.default_rng(6).uniform(-9, 9, (90, 3))
    with pytest.raises(DegenerateGeometryError, match="too many to be matched"):
        lr.name_targets([_target(center) for center in places], {f"T{k}": place for k, place in enumerate(places)})


@pytest.mark.slow
def test_flat_targets_are_found_among_pictures_on_the_wall():
    scan = _empty_scan()
    light = np.random.default_rng(2).uniform(0.2, 0.7, (12, 30)).repeat(18, 0).repeat(18, 1)
    scan = replace(scan, intensity=light[: scan.shape[0], : scan.shape[1]].astype(np.float32))
    centers = _WORLD * 0.6
    scan = with_plates(scan, centers, np.tile([0.3, 0.2, 0.1], (len(centers), 1)), 0.2, noise_m=_NOISE)
    found = lr.find_targets(scan, side_m=0.2)
    away = np.linalg.norm(np.array([one.center for one in found])[:, None] - centers, axis=-1)
    assert (away.min(axis=0) < 0.003).all()
    assert all(one.side_m == 0.2 for one in found)
    assert len(lr.name_targets(found, dict(zip(_NAMES, _WORLD * 0.6, strict=True)))) == len(_NAMES)


@pytest.mark.slow
def test_flat_targets_come_before_corners_of_prints() -> None:
    """Blocks of grey meet in corners that look like quadrants on one ring, and do not go on as such."""
    scan = _empty_scan()
    light = np.random.default_rng(5).uniform(0.1, 0.9, (40, 90)).repeat(6, 0).repeat(6, 1)
    scan = replace(scan, intensity=light[: scan.shape[0], : scan.shape[1]].astype(np.float32))
    centers = _WORLD * 0.6
    scan = with_plates(scan, centers, np.tile([0.5, 0.1, -0.1], (len(centers), 1)), 0.2, noise_m=_NOISE)
    candidates = [one for found in _candidates(scan, 0.1, is_sphere=False) for one in found]
    ranked = [scan.rays[one.cell] * scan.ranges[one.cell] for one in _apart(scan, candidates, 0.1)]
    assert len(ranked) > 3 * len(centers), "the control: prints are candidates"
    for center in centers:
        places = np.flatnonzero(np.linalg.norm(np.array(ranked) - center, axis=1) < 0.05)
        assert places[0] < len(centers) + 2
    found = lr.find_targets(scan, side_m=0.2)
    away = np.linalg.norm(np.array([one.center for one in found])[:, None] - centers, axis=-1)
    assert (away.min(axis=0) < 0.003).all()


@pytest.mark.parametrize("size", [{}, {"radius_m": 0.1, "side_m": 0.1}, {"radius_m": -1.0}, {"side_m": np.nan}])
def test_sizes_that_are_none_are_refused_in_the_search(size):
    with pytest.raises(OptionError):
        lr.find_targets(_empty_scan(), **size)


def _target(center: np.ndarray) -> lr.SurveyTarget:
    return lr.SurveyTarget(np.asarray(center), 1e-6 * np.eye(3), _RADIUS, 0.001, 50, 0)
