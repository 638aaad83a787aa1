"""Survey targets in the scans of a survey: they hold the stations, and their world is that of the survey."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.errors import DegenerateGeometryError, FormatError, OptionError
from ladarreg_core.frames import Rigid, look_along
from ladarreg_core.scan import Scan
from ladarreg_core.simulate.photograph import Lighting, take_photograph
from ladarreg_core.simulate.stations import scan_stations, station_room, upright_pose, with_spheres
from ladarreg_core.survey.least_squares.problem import pose_difference
from ladarreg_core.survey.local_world import local_origin
from ladarreg_core.survey.parts import ScanTargets, SurveyScan
from ladarreg_core.survey.stations import place_stations
from ladarreg_core.survey.survey import Survey

RADIUS_M = 0.08
POSES = (upright_pose(np.array([-0.8, -0.4, 0.0]), 0.2), upright_pose(np.array([0.7, 0.6, 0.1]), -0.3))
WORLD = Rigid.from_rotvec([0.0, 0.0, 0.7], [312.0, 41.0, 88.0])
"""The surveyor's coordinates from those of the room."""


@pytest.fixture(scope="module")
def hall() -> tuple[list[Scan], np.ndarray]:
    """Two scans with spheres, and where these are in the room."""
    scans = scan_stations(station_room("office", 3), POSES, seed=4, step_deg=0.4)
    rng, spheres = np.random.default_rng(8), []
    while len(spheres) < 6:
        at = rng.uniform([-2.0, -2.0, -0.6], [2.0, 2.0, 0.8])
        if all(_is_free(scan, pose.inverse @ at) for scan, pose in zip(scans, POSES, strict=True)) and all(
            np.linalg.norm(at - other) > 0.5 for other in spheres
        ):
            spheres.append(at)
    places = np.array(spheres)
    seen = [with_spheres(scan, pose.inverse @ places, RADIUS_M, noise_m=0.002, seed=k)
            for k, (scan, pose) in enumerate(zip(scans, POSES, strict=True))]  # fmt: skip
    return seen, places


def _is_free(scan: Scan, at: np.ndarray) -> bool:
    length = np.linalg.norm(at)
    near = scan.rays @ (at / length) > np.cos(2 * RADIUS_M / length)
    return bool(0.9 < length < 2.5 and np.nanmin(scan.ranges[near]) > length + 3 * RADIUS_M)


@pytest.fixture
def targets(hall: tuple[list[Scan], np.ndarray], tmp_path: Path) -> Callable[..., ScanTargets]:
    """Write the targets of a scan as a surveyor states them."""

    def written(number: int, world: Rigid = WORLD, exchanged: bool = False) -> ScanTargets:
        scans, places = hall
        lines = ["name,row,column,x,y,z"]
        surveyed = world @ places
        for k, at in enumerate(POSES[number].inverse @ places):
            toward = scans[number].rays @ (at / np.linalg.norm(at))
            row, column = np.unravel_index(np.argmax(toward), toward.shape)
            x, y, z = surveyed[(k + exchanged) % len(places)]
            lines.append(f"S{k},{row},{column},{x!r},{y!r},{z!r}".replace("np.float64(", "").replace(")", ""))
        path = tmp_path / f"targets{number}.csv"
        path.write_text("\n".join(lines) + "\n")
        return ScanTargets(source=path, radius_m=RADIUS_M)

    return written


def _apart(first: Rigid | None, second: Rigid) -> float:
    """Return how far apart two scanners stand, m."""
    assert first is not None
    return float(np.linalg.norm(first.translation - second.translation))


def _given(scans: list[Scan], *held: ScanTargets | None) -> list[SurveyScan]:
    return [
        SurveyScan(id=f"s{k}", source=scan, targets=one) for k, (scan, one) in enumerate(zip(scans, held, strict=True))
    ]


@pytest.mark.slow
def test_targets_hold_stations_in_their_world(hall, targets) -> None:
    scans, _ = hall
    found = place_stations(_given(scans, targets(0), targets(1)), scans)
    for station, pose in zip(found.each, POSES, strict=True):
        assert not station.fixed
        assert _apart(station.world_from_scanner, WORLD @ pose) < 0.004
        assert "Held by 6 survey targets" in station.reasons[0]
    known = found.relative([0, 1])
    held = [one for one in known if one.name == "its survey targets"]
    assert [(one.body, one.base) for one in held] == [(0, -1), (1, -1)]
    for one, pose in zip(held, POSES, strict=True):
        off = pose_difference((WORLD @ pose).inverse, one.pose)
        assert off @ np.linalg.solve(one.covariance, off) / 6 < 3.5
    assert any("surfaces" in one.name for one in known)


@pytest.mark.slow
def test_a_station_without_targets_is_registered_into_their_world(hall, targets) -> None:
    scans, _ = hall
    foreign = replace(scans[0], world_from_scanner=Rigid.from_rotvec([0, 0, 1.0], [5.0, 0.0, 0.0]))
    found = place_stations(_given([foreign, scans[1]], None, targets(1)), [foreign, scans[1]])
    first = found.each[0].world_from_scanner
    assert first is not None, "what its file states is of another world"
    assert _apart(first, WORLD @ POSES[0]) < 0.01
    assert found.each[0].by_targets is None


def test_a_single_scan_stands_where_its_targets_say(hall, targets) -> None:
    scans, _ = hall
    (station,) = place_stations(_given(scans[:1], targets(0)), scans[:1]).each
    assert station.by_targets is not None
    assert _apart(station.world_from_scanner, WORLD @ POSES[0]) < 0.004


@pytest.mark.slow
def test_targets_that_contradict_the_surfaces_are_refused(hall, targets) -> None:
    scans, _ = hall
    other = Rigid(np.eye(3), np.array([0.06, 0.0, 0.0])) @ WORLD
    with pytest.raises(DegenerateGeometryError, match=r"scans s0 and s1 6\d mm .* of one datum"):
        place_stations(_given(scans, targets(0), targets(1, other)), scans)


@pytest.mark.slow
def test_a_fixed_scan_that_contradicts_targets_is_refused(hall, targets) -> None:
    scans, _ = hall
    off = Rigid(np.eye(3), np.array([0.0, 0.05, 0.0])) @ WORLD @ POSES[0]
    fixed = SurveyScan(id="fixed", source=scans[0], world_from_scanner=off, fixed=True)
    given = [fixed, _given(scans, None, targets(1))[1]]
    with pytest.raises(DegenerateGeometryError, match="fixed and s1"):
        place_stations(given, scans)
    right = replace(fixed, world_from_scanner=WORLD @ POSES[0])
    assert place_stations([right, given[1]], scans).each[0].fixed


def test_targets_with_exchanged_names_or_no_radius_are_refused_by_name(hall, targets) -> None:
    scans, _ = hall
    with pytest.raises(DegenerateGeometryError, match="scan s0: "):
        place_stations(_given(scans[:1], targets(0, exchanged=True)), scans[:1])
    with pytest.raises(OptionError, match="scan s0: the radius of the targets S0"):
        place_stations(_given(scans[:1], replace(targets(0), radius_m=None)), scans[:1])
    with pytest.raises(DegenerateGeometryError, match="scan s0: target S0: "):
        place_stations(_given(scans[:1], replace(targets(0), radius_m=0.3)), scans[:1])


@pytest.mark.slow
def test_coordinates_of_a_national_grid_lose_no_digits(hall, targets) -> None:
    scans, _ = hall
    grid = Rigid(np.eye(3), np.array([512_300.0, 5_400_100.0, 0.0])) @ WORLD
    given = _given(scans, targets(0, grid), targets(1, grid))
    origin = local_origin(given, scans)
    assert np.abs(origin - grid.translation).max() < 30
    found = place_stations(given, scans, origin=origin)
    for station, pose in zip(found.each, POSES, strict=True):
        local = Rigid(np.eye(3), -origin) @ grid @ pose
        assert _apart(station.world_from_scanner, local) < 0.004


def _survey_file(folder: Path, scan: dict[str, object]) -> Path:
    for name in ("hall.npz", "photo.jpg", "spheres.csv"):
        (folder / name).write_bytes(b"x")
    stated = {"version": 1, "scans": [{"id": "hall", "path": "hall.npz", **scan}], "cameras": [{"id": "c"}],
              "photos": [{"id": "p", "path": "photo.jpg", "camera": "c"}]}  # fmt: skip
    (folder / "survey.json").write_text(json.dumps(stated))
    return folder / "survey.json"


def test_the_file_states_targets(tmp_path: Path) -> None:
    path = _survey_file(tmp_path, {"targets": "spheres.csv", "radius_m": 0.0725, "sigma_m": 0.002})
    survey = Survey.from_file(path)
    assert survey.scans[0].targets == ScanTargets(source=tmp_path / "spheres.csv", radius_m=0.0725, sigma_m=0.002)
    survey.to_file(tmp_path / "again.json")
    assert Survey.from_file(tmp_path / "again.json").scans[0].targets == survey.scans[0].targets
    plain = Survey.from_file(_survey_file(tmp_path, {}))
    plain.to_file(path)
    assert "targets" not in json.loads(path.read_text())["scans"][0]


@pytest.mark.parametrize(
    ("scan", "said"),
    [({"targets": "none.csv"}, "not found"), ({"targets": 3}, "has no path"), ({"radius_m": 0.1}, "has none"),
     ({"targets": "spheres.csv", "radius_m": -1}, "radius_m is -1"),
     ({"targets": "spheres.csv", "sigma_m": "x"}, "sigma_m is 'x'"),
     ({"targets": "spheres.csv", "fixed": True}, "is fixed and has targets")],
)  # fmt: skip
def test_faults_of_targets_are_listed(tmp_path: Path, scan: dict[str, object], said: str) -> None:
    with pytest.raises(FormatError, match=said):
        Survey.from_file(_survey_file(tmp_path, scan))


@pytest.mark.slow
def test_an_adjustment_is_in_the_world_of_the_targets(hall, targets) -> None:
    """The scans are held within the covariance of their targets, and the photographs agree with their own."""
    scans, _ = hall
    camera = lr.Camera(640, 480, 480.0, 480.0, 319.5, 239.5)
    photos, truth = [], []
    for k, axis in enumerate(([1.0, 0.15, -0.05], [0.3, 1.0, 0.0], [-1.0, 0.2, 0.0])):
        pose = Rigid.from_centre(look_along(axis), np.array([-0.6, -0.1, 0.1]))
        pixels = take_photograph(
            *station_room("office", 3), camera, pose, lighting=Lighting(), rng=np.random.default_rng(k)
        )
        photos.append(lr.Photo(pixels=pixels, camera=camera, name=f"p{k}", calibrated=True))
        truth.append(pose @ WORLD.inverse)
    plain = Survey.of(scans, photos, cameras=[0, 0, 0])
    survey = replace(plain, scans=tuple(replace(one, targets=targets(k)) for k, one in enumerate(plain.scans)))
    found = lr.adjust(survey, processes=1)
    for one, pose in zip(found.scans.values(), POSES, strict=True):
        assert one.accepted
        assert not one.fixed
        assert _apart(one.world_from_scanner, WORLD @ pose) < 0.004
        assert 1e-5 < np.sqrt(np.diag(one.covariance)[3:].sum()) < 4e-3
    accepted = [(one, true) for one, true in zip(found.photos.values(), truth, strict=True) if one.accepted]
    assert accepted
    for one, true in accepted:
        off = pose_difference(true, one.camera_from_world)
        assert off @ np.linalg.solve(one.covariance, off) < 27.9  # exceeded once in 10,000


@pytest.fixture
def picked(hall: tuple[list[Scan], np.ndarray], tmp_path: Path) -> Callable[..., ScanTargets]:
    """Write the picks of a scan, with the coordinates of some of its targets."""

    def written(number: int, surveyed: tuple[int, ...] = (), moved: dict[int, int] | None = None) -> ScanTargets:
        scans, places = hall
        lines = ["name,row,column,x,y,z"]
        for k, at in enumerate(POSES[number].inverse @ places):
            toward = scans[number].rays @ (at / np.linalg.norm(at))
            row, column = np.unravel_index(np.argmax(toward), toward.shape)
            place = ",".join(str(float(v)) for v in WORLD @ places[k]) if k in surveyed else ",,"
            lines.append(f"S{(moved or {}).get(k, k)},{row},{column},{place}")
        path = tmp_path / f"picks{number}.csv"
        path.write_text("\n".join(lines) + "\n")
        return ScanTargets(source=path, radius_m=RADIUS_M)

    return written


def _apart_rooms(scans: list[Scan]) -> list[Scan]:
    """Return scans that share nothing but their spheres: of the second, all else is of another room."""
    (other,) = scan_stations(station_room("boxes", 77), [POSES[1]], seed=9, step_deg=0.4)
    ranges = np.where(np.abs(scans[1].ranges - _without_spheres()) > 1e-3, scans[1].ranges, other.ranges)
    return [scans[0], replace(scans[1], ranges=ranges.astype(np.float32))]


def _without_spheres() -> np.ndarray:
    return scan_stations(station_room("office", 3), POSES, seed=4, step_deg=0.4)[1].ranges


@pytest.mark.slow
def test_a_scan_that_shares_no_surface_is_joined_by_shared_targets(hall, targets, picked) -> None:
    scans = _apart_rooms(hall[0])
    alone = place_stations(_given(scans, targets(0), None), scans)
    assert alone.each[1].world_from_scanner is None, "the control: surfaces do not join them"
    found = place_stations(_given(scans, targets(0), picked(1, (2,))), scans)
    assert _apart(found.each[1].world_from_scanner, WORLD @ POSES[1]) < 0.005
    assert "Joined to scan s0 by 6 survey targets" in found.each[1].reasons[0]
    assert not found.each[1].fixed
    (known,) = (one for one in found.relative([0, 1]) if "survey targets of scans 1 and 2" in one.name)
    off = pose_difference((POSES[0].inverse @ POSES[1]).inverse, known.pose)
    assert (known.body, known.base) == (1, 0)
    assert off @ np.linalg.solve(known.covariance, off) / 6 < 3.5


@pytest.mark.slow
def test_scans_without_coordinates_are_joined_in_the_frame_of_the_first(hall, picked) -> None:
    scans = _apart_rooms(hall[0])
    found = place_stations(_given(scans, picked(0), picked(1)), scans)
    assert found.each[0].fixed
    assert _apart(found.each[1].world_from_scanner, POSES[0].inverse @ POSES[1]) < 0.006


@pytest.mark.slow
def test_coordinates_scattered_over_scans_make_the_world(hall, picked) -> None:
    scans = _apart_rooms(hall[0])
    found = place_stations(_given(scans, picked(0, (0, 3)), picked(1, (1, 5))), scans)
    assert found.each[0].by_targets is not None
    for station, pose in zip(found.each, POSES, strict=True):
        assert _apart(station.world_from_scanner, WORLD @ pose) < 0.008


@pytest.mark.slow
def test_shared_targets_that_contradict_the_surfaces_are_refused(hall, targets, picked) -> None:
    scans, places = hall
    moved = lr.Rigid(np.eye(3), np.array([0.04, 0.0, 0.0]))
    own = POSES[1].inverse @ moved @ places
    other = with_spheres(scan_stations(station_room("office", 3), POSES, seed=4, step_deg=0.4)[1], own, RADIUS_M,
                         noise_m=0.002, seed=1)  # fmt: skip
    with pytest.raises(DegenerateGeometryError, match="the scans s0 and s1 share put them"):
        place_stations(_given([scans[0], other], targets(0), picked(1)), [scans[0], other])
