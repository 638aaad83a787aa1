"""Where the scanner stood: given, found from the points, or asked for; what is dropped is said."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ladarreg_core.errors import ShapeError, UnderspecifiedError
from ladarreg_core.formats.registry import read_scan
from ladarreg_core.formats.scans.cloud import scan_of_cloud
from ladarreg_core.frames import Rigid
from ladarreg_core.scan import Scan
from ladarreg_core.scanner import origin
from ladarreg_core.scanner.cloud import locate_cloud
from ladarreg_core.scanner.origin import estimate_origin
from testing.scenes.origin_cases import UNEVEN_DEG, draw_origin_case
from testing.scenes.simulated_clouds import brightness, dome, in_room, in_street, of_elevations, rosette, spinning

IN_ROOM = np.array([0.4, -0.6, 1.5])
IN_STREET = np.array([0.0, 0.0, 1.8])
UTM = np.array([691_234.567, 5_334_321.125, 519.25])


def cloud(kind: str) -> np.ndarray:
    """Return the points (N, 3) of a pattern of beams in a place, scanner frame."""
    if kind == "room, terrestrial":
        return in_room(dome(1.0)) - IN_ROOM
    if kind == "room, spinning":
        return in_room(spinning(16, 900)) - IN_ROOM
    if kind == "room, rosette":
        return in_room(rosette(150_000)) - IN_ROOM
    if kind == "street, terrestrial":
        return in_street(dome(1.0)) - IN_STREET
    return in_street(spinning(32, 900)) - IN_STREET


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "moved", "within_m"),
    [
        ("room, terrestrial", UTM, 0.03),
        ("room, spinning", np.array([14.0, 5.0, 1.0]), 0.03),
        pytest.param("room, rosette", np.array([14.0, 5.0, 1.0]), 0.4, marks=pytest.mark.long),
        ("street, terrestrial", np.array([60.0, -80.0, 3.0]), 0.05),
        ("street, spinning", UTM, 0.05),
    ],
)
def test_the_scanner_is_found_wherever_the_cloud_was_moved(kind: str, moved: np.ndarray, within_m: float) -> None:
    points = cloud(kind)
    found = estimate_origin(points + moved)
    assert found.position is not None
    assert np.linalg.norm(np.array(found.position) - moved) < within_m
    assert found.hidden_share < 0.5 * found.hidden_from_centre
    assert estimate_origin(points).position == (0, 0, 0), "a centred cloud must stay where it is, exactly"


@pytest.mark.slow
def test_a_cloud_from_two_places_has_no_origin_and_asks_for_one() -> None:
    two = np.concatenate([in_room(dome(1.2)), in_room(dome(1.2), (-3.2, 3.4, 1.4))]) + UTM
    assert estimate_origin(two).position is None
    with pytest.raises(UnderspecifiedError, match="`origin` as x, y, z"):
        scan_of_cloud(two, brightness(two - UTM), name="two")
    given = scan_of_cloud(two, brightness(two - UTM), name="two", origin=UTM + IN_ROOM)
    assert any("as given" in note for note in given.notes)


@pytest.mark.slow
def test_points_that_are_read_again_are_not_estimated_again(monkeypatch: pytest.MonkeyPatch) -> None:
    points = cloud("room, spinning") + np.array([2, 1, 0.5])
    found = estimate_origin(points)

    def measured_again(*_: object) -> None:
        raise AssertionError("the points were estimated before")

    monkeypatch.setattr(origin, "_estimate", measured_again)
    assert estimate_origin(points.copy()) == found
    with pytest.raises(AssertionError, match="before"):
        estimate_origin(points + 1e-6)


@pytest.mark.slow
def test_points_without_the_pattern_of_a_scanner_have_no_origin() -> None:
    generator = np.random.default_rng(4)
    floor = np.column_stack([generator.uniform(-20, 20, (20_000, 2)), generator.normal(0, 0.005, 20_000)])
    assert estimate_origin(floor + UTM).position is None


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "verdict"),
    [(4, "right"), (6, "asked"), (7, "asked"), (8, "asked"), (9, "right"), (15, "right"), (50, "right"), (86, "asked")],
)
def test_drawn_clouds_are_placed_rightly_or_asked_for(seed: int, verdict: str) -> None:
    case = draw_origin_case(seed)
    assert case.verdict(estimate_origin(case.points)) == verdict, case.name


@pytest.mark.parametrize("kind", ["64 rings", "64 uneven rings"])
def test_rings_of_any_spacing_are_seen_from_zero(kind: str) -> None:
    rays = spinning(64, 600) if kind == "64 rings" else of_elevations(UNEVEN_DEG, 600)
    points = in_street(rays) - IN_STREET
    assert estimate_origin(points).position == (0, 0, 0)


@pytest.mark.slow
def test_zero_on_the_ground_below_the_scanner_is_not_taken() -> None:
    points = in_street(spinning(64, 900))  # the scanner stood at 0, 0, 1.8
    found = estimate_origin(points).position
    assert found is not None
    np.testing.assert_allclose(found, IN_STREET, atol=0.1)


@pytest.mark.slow
def test_a_stated_place_is_taken_where_the_points_confirm_it_and_the_pose_not_applied_twice() -> None:
    place = np.array([12.0, -7.0, 1.6])
    pose = Rigid(np.eye(3), place)
    points = in_room(dome(1.0)) - IN_ROOM
    paint = brightness(points)
    in_world = locate_cloud(points + place, paint, stated=[("VIEWPOINT", place)], world_from_scanner=pose)
    assert any("as VIEWPOINT says" in note for note in in_world.notes)
    own = locate_cloud(points, paint, stated=[("VIEWPOINT", place)], world_from_scanner=pose)
    given = locate_cloud(points + place, paint, origin=place, stated=[("VIEWPOINT", place)], world_from_scanner=pose)
    for located in (in_world, own, given):
        assert located.world_from_scanner is not None
        np.testing.assert_allclose(located.world_from_scanner.translation, place, atol=1e-9)
    assert [any("given" in note for note in each.notes) for each in (in_world, own, given)] == [False, False, True]


def test_a_map_in_single_precision_is_refused_with_its_step() -> None:
    points = (in_room(dome(4.0)) + UTM).astype(np.float32)
    with pytest.raises(ShapeError, match=r"single precision.* 0\.5 m apart"):
        scan_of_cloud(points, brightness(points), name="map", origin=UTM)


def test_few_points_are_asked_for(tmp_path: Path) -> None:
    points = np.random.default_rng(0).uniform(-5, 5, (300, 3))
    with pytest.raises(UnderspecifiedError, match="`origin`"):
        read_scan(_pcd(tmp_path / "few.pcd", points))
    assert read_scan(_pcd(tmp_path / "few.pcd", points), origin=(0, 0, 0)).valid.any()


def _pcd(path: Path, points: np.ndarray, code: str = "f4") -> Path:
    size = int(code[1])
    record = np.zeros(len(points), [("x", code), ("y", code), ("z", code), ("intensity", "f4")])
    for axis, name in enumerate("xyz"):
        record[name] = points[:, axis]
    record["intensity"] = brightness(points - points.mean(axis=0))
    header = (
        f"VERSION .7\nFIELDS x y z intensity\nSIZE {size} {size} {size} 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
        f"WIDTH {len(points)}\nHEIGHT 1\nPOINTS {len(points)}\nDATA binary\n"
    )
    path.write_bytes(header.encode() + record.tobytes())
    return path


def _share(scan: Scan, points: np.ndarray) -> float:
    return float(scan.valid.sum() / len(points))


@pytest.mark.slow
def test_a_moved_cloud_is_noticed_and_keeps_its_points(tmp_path: Path) -> None:
    points = cloud("room, terrestrial")
    file = _pcd(tmp_path / "moved.pcd", points + np.array([14, 5, 1]))
    scan = read_scan(file)
    assert _share(scan, points) > 0.95
    assert any("was estimated" in note and "`origin`" in note for note in scan.notes)
    assert scan.world_from_scanner is not None
    np.testing.assert_allclose(scan.world_from_scanner.translation, [14, 5, 1], atol=0.03)

    wrong = read_scan(file, origin=(0, 0, 0))  # the control: as it was read before
    assert _share(wrong, points) < 0.7
    assert any("lie behind others and were dropped" in note and "`origin`" in note for note in wrong.notes)


def _frame(lidar: str, place: str, seed: int, share: int) -> np.ndarray:
    """The first of a lidar's returns outdoors, from which patterns of points say little."""
    pytest.importorskip("embreex", reason="the simulator needs the extra `simulate`")
    from ladarreg_core.simulate.outdoor_case import simulate_outdoors

    points = simulate_outdoors(place, lidar=lidar, seed=seed).cloud.points.astype(np.float64)  # type: ignore[arg-type]
    return points[: len(points) // share]


@pytest.mark.long
@pytest.mark.parametrize(
    ("lidar", "place", "seed", "share"),
    [
        ("narrow", "courtyard", 9, 2),
        ("petals", "courtyard", 7, 2),
        ("128 lines", "street", 7, 1),
    ],
)
def test_frames_of_a_lidar_are_not_moved_away_from_the_zero_point(
    lidar: str, place: str, seed: int, share: int, tmp_path: Path
) -> None:
    points = _frame(lidar, place, seed, share)
    scan = read_scan(_pcd(tmp_path / "frame.pcd", points))
    assert scan.world_from_scanner is None
    on_the_ground = _pcd(tmp_path / "ground.pcd", points + np.array([0, 0, 1.7]))
    try:  # from zero, on the ground now, most of the points would be hidden
        moved = read_scan(on_the_ground)
    except UnderspecifiedError:
        return
    assert moved.world_from_scanner is not None
    np.testing.assert_allclose(moved.world_from_scanner.translation, [0, 0, 1.7], atol=0.3)


def test_coordinates_of_millions_of_metres_keep_their_millimetres(tmp_path: Path) -> None:
    points = cloud("room, terrestrial")[::3]
    scan = read_scan(_pcd(tmp_path / "utm.pcd", points + UTM, "f8"), origin=tuple(UTM.tolist()))
    assert scan.world_from_scanner is not None
    np.testing.assert_array_equal(scan.world_from_scanner.translation, UTM)
    expected = np.sort(np.linalg.norm(points, axis=1))
    found = np.sort(scan.ranges[scan.valid])
    spread = np.interp(np.linspace(0, 1, 200), np.linspace(0, 1, len(expected)), expected)
    np.testing.assert_allclose(
        np.interp(np.linspace(0, 1, 200), np.linspace(0, 1, len(found)), found), spread, atol=0.02
    )
    nearest = np.abs(expected[np.searchsorted(expected, found).clip(max=len(expected) - 1)] - found)
    assert np.median(nearest) < 1e-4
    rounded = (points + UTM).astype(np.float32).astype(np.float64) - UTM  # the control: subtracted too late
    assert np.abs(np.linalg.norm(rounded, axis=1) - np.linalg.norm(points, axis=1)).max() > 0.1
