"""Lengths that came with matches: used as measured, compared with the scan, and refused where they disagree."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ladarreg.messages import length_lines

import ladarreg_core as lr
from ladarreg_core.errors import FormatError, OptionError, ShapeError
from ladarreg_core.export.json import registration_document
from ladarreg_core.formats.documents.matches_file import read_matches, write_matches
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.frames import Rigid
from ladarreg_core.inspection.picks import pick_points
from ladarreg_core.matching.image_check import ImageCheck, with_image_check
from ladarreg_core.picks.lengths import check_lengths
from ladarreg_core.picks.measure import matches_from_picks
from ladarreg_core.quality.findings import findings
from ladarreg_core.registration.register import RegisterOptions, register
from ladarreg_core.surface.ranges import surface_range
from testing.scenes.painted_room import PaintedRoom, painted_room

UTM = Rigid.from_rotvec([0.004, -0.003, 2.1], (500_123.4567, 5_412_345.6789, 102.3456))


@pytest.fixture(scope="module")
def room() -> PaintedRoom:
    return painted_room(seed=3)


@pytest.fixture(scope="module")
def targets(room: PaintedRoom) -> tuple[FloatArray, FloatArray]:
    """Points (24, 3) m in the scanner's frame, measured to 3 mm, and their pixels (24, 2)."""
    rng = np.random.default_rng(5)
    rays = room.scan.rays[rng.integers(30, 270, 300), rng.integers(30, 390, 300)]
    points = rays * surface_range(room.scan, rays)[:, None]
    uv = room.photo.camera.project(room.camera_from_scanner @ points)
    good = np.flatnonzero(room.photo.camera.contains(uv, border=5))[:24]
    away = rays[good] * rng.normal(0, 0.003, (len(good), 1))
    return points[good] + away, uv[good] + rng.normal(0, 0.4, (len(good), 2))


def written(path: Path, points: FloatArray, uv: FloatArray, frame: str = "scanner") -> Path:
    rows = [
        f"T{k + 1},{frame},{','.join(f'{v:.6f}' for v in (*p, *at))}"
        for k, (p, at) in enumerate(zip(points, uv, strict=True))
    ]
    path.write_text("\n".join(["name,frame,x,y,z,u,v", *rows]), encoding="utf-8")
    return path


def test_targets_in_the_world_register_and_keep_their_lengths(
    tmp_path: Path, room: PaintedRoom, targets: tuple[FloatArray, FloatArray]
) -> None:
    points, uv = targets
    scan = replace(room.scan, world_from_scanner=UTM)
    path = written(tmp_path / "t.csv", UTM @ points, uv, "world")
    picks = read_matches(path, scan)
    np.testing.assert_allclose([p.lengths_m for p in picks], np.linalg.norm(points, axis=1)[:, None], atol=2e-6)
    result = register(scan, room.photo, picks=picks)
    assert result.accepted, result.reasons
    np.testing.assert_allclose(result.matches.ranges, np.linalg.norm(points, axis=1), atol=2e-6)
    assert result.camera_centre_world is not None
    truth = UTM @ room.camera_from_scanner.centre
    assert np.linalg.norm(result.camera_centre_world - truth) < 0.03
    document = registration_document(result)
    match = document["matches"][3]
    assert (match["name"], match["range_is"]) == ("T4", "as stated with the match")
    assert match["length_minus_scan_m"] == pytest.approx(match["range_m"] - match["scan_range_m"])
    assert abs(match["length_minus_scan_m"]) < 0.02
    table = length_lines(result)
    assert len(table) == 3 + 24
    assert "T4" in table[6]
    finding = next(one for one in findings(result) if one.name == "lengths")
    assert finding.level == "good"
    assert finding.values["compared"] == 24
    with pytest.raises(FormatError, match="does not say where the scanner stands"):
        read_matches(path, room.scan)
    far = written(tmp_path / "far.csv", UTM @ points, uv)
    with pytest.raises(FormatError, match="need the frame 'world'"):
        read_matches(far, scan)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scale", "words"),
    [
        (1.1, "1.10 x"),
        (0.98, "0.98 x"),
        (3.28084, "feet"),
        (1000.0, "1000 x the scan's: unit or scale? They look like millimetres."),
        (0.001, "in millimetres"),
    ],
)
def test_a_common_scale_is_recognised_and_refused(
    tmp_path: Path, room: PaintedRoom, targets: tuple[FloatArray, FloatArray], scale: float, words: str
) -> None:
    points, uv = targets
    picks = read_matches(written(tmp_path / "t.csv", points * scale, uv), room.scan)
    result = register(room.scan, room.photo, picks=picks)
    assert not result.accepted
    assert result.evidence == "none"
    assert result.reasons[0].startswith("All lengths are" if abs(scale - 1) > 0.05 else "Most lengths are")
    assert words in result.reasons[0]
    assert "unit or scale?" in result.reasons[0]
    # Control: as bare rays, which is how such targets used to be read, the same file is accepted.
    rays = [replace(pick, lengths_m=None) for pick in picks]
    assert register(room.scan, room.photo, picks=rays).accepted


def test_the_worst_are_named_and_a_tolerance_lets_them_pass(
    tmp_path: Path, room: PaintedRoom, targets: tuple[FloatArray, FloatArray]
) -> None:
    points, uv = targets[0].copy(), targets[1]
    reach = np.linalg.norm(points, axis=1)
    points[6] *= 1 + 0.2 / reach[6]
    points[11] *= 1 - 0.35 / reach[11]
    picks = read_matches(written(tmp_path / "t.csv", points, uv), room.scan)
    result = register(room.scan, room.photo, picks=picks)
    assert not result.accepted
    assert result.reasons[0].startswith("2 of 24 lengths differ")
    assert result.reasons[0].index("T12 -0.3") < result.reasons[0].index("T7 +0.")
    assert "x the scan's" not in " ".join(result.reasons)
    assert next(one for one in findings(result) if one.name == "lengths").level == "poor"
    # what the images say of the pose says nothing about the lengths
    again = with_image_check(result, ImageCheck("undecidable", "The images could not confirm it.", None))
    assert not again.accepted
    allowed = register(room.scan, room.photo, picks=picks, options=RegisterOptions(match_tolerance_m=0.5))
    assert allowed.accepted
    assert allowed.options["match_tolerance_m"] == 0.5
    off = [replace(pick, on=pick.name not in ("T7", "T12")) for pick in picks]
    assert register(room.scan, room.photo, picks=off).accepted
    thesis = register(room.scan, room.photo, method="thesis", picks=picks)
    assert not thesis.accepted
    assert thesis.reasons[0] == result.reasons[0]
    with pytest.raises(OptionError, match="match_tolerance_m"):
        RegisterOptions(match_tolerance_m=0.0)


def test_the_tolerance_follows_the_noise_of_the_scan(
    tmp_path: Path, room: PaintedRoom, targets: tuple[FloatArray, FloatArray]
) -> None:
    noise = np.random.default_rng(1).normal(0, 0.04, room.scan.shape)
    coarse = replace(room.scan, ranges=room.scan.ranges + noise)
    picks = read_matches(written(tmp_path / "t.csv", *targets), coarse)
    check = check_lengths(coarse, picks)
    assert check is not None
    assert not check.refusal
    assert max(abs(one.difference_m or 0) for one in check.lengths) > 0.05
    assert check_lengths(coarse, picks, tolerance_m=0.05).refusal  # type: ignore[union-attr]


def test_coordinates_of_a_small_world_without_their_frame_are_recognised(
    tmp_path: Path, room: PaintedRoom, targets: tuple[FloatArray, FloatArray]
) -> None:
    points, uv = targets
    local = Rigid.from_rotvec([0, 0, 0.4], (1.5, -0.8, 0.3))
    scan = replace(room.scan, world_from_scanner=local)
    picks = read_matches(written(tmp_path / "t.csv", local @ points, uv), scan)  # the frame should be 'world'
    check = check_lengths(scan, picks)
    assert check is not None
    assert check.refusal[0].endswith("state the frame 'world'.")
    without = check_lengths(room.scan, picks)
    assert without is not None
    assert "'world'" not in " ".join(without.refusal)
    far = check_lengths(scan, read_matches(written(tmp_path / "far.csv", 1.2 * points, uv), scan))
    assert far is not None
    assert "'world'" not in " ".join(far.refusal)


def test_points_without_a_return_are_used_with_their_own_length(room: PaintedRoom) -> None:
    ranges = np.array(room.scan.ranges)
    ranges[100:104, 200:204] = np.nan
    scan = replace(room.scan, ranges=ranges)
    ray = scan.geometry.ray_at(np.array([101.5, 201.5]))
    pick = lr.Pick("1", "point", ray[None], np.array([[20.0, 30.0]]), lengths_m=np.array([4.25]), name="ball")
    matches, notes = matches_from_picks(scan, [pick])
    assert matches.ranges.tolist() == [4.25]
    assert notes == ()
    check = check_lengths(scan, [pick])
    assert check is not None
    assert (check.compared, check.refusal) == ((), ())
    assert check.lengths[0].state == "no return"
    assert check.note == "The scan has no range to compare with at ball: its own length is used."
    np.testing.assert_allclose(pick_points(scan, [pick])[0], 4.25 * ray[None])
    behind = replace(pick, scan=np.array([[-1.0, 0.0, 0.0]]))  # where the scanner never looked
    outside = check_lengths(scan, [behind])
    assert outside is not None
    assert "outside of what it saw" in outside.refusal[0]


def test_at_a_depth_edge_only_what_neither_surface_explains_is_refused(room: PaintedRoom) -> None:
    scan = room.scan
    steps = np.nan_to_num(np.abs(np.diff(scan.ranges, axis=1)))
    row, column = np.unravel_index(int(np.argmax(steps)), steps.shape)
    near, far = sorted(scan.ranges[row, column : column + 2].tolist())
    assert far > 1.1 * near
    ray = scan.geometry.ray_at(np.array([float(row), column + 0.5]))

    def refused(length: float) -> bool:
        pick = lr.Pick("1", "point", ray[None], np.array([[20.0, 30.0]]), lengths_m=np.array([length]))
        check = check_lengths(scan, [pick])
        assert check is not None
        return bool(check.refusal)

    assert not any(map(refused, (near, (near + far) / 2, far)))
    assert all(map(refused, (0.8 * near, 1.2 * far)))


def test_a_line_between_two_points_is_straight_in_space(room: PaintedRoom) -> None:
    ends = np.array([[3.0, -1.0, 0.2], [4.5, 1.5, 1.2]])
    lengths = np.linalg.norm(ends, axis=1)
    pick = lr.Pick("a", "line", ends, np.array([[10.0, 20.0], [30.0, 5.0]]), lengths_m=lengths)
    matches, _ = matches_from_picks(room.scan, [pick], lines="equal", samples_per_line=5)
    along = np.linalg.norm(np.cross(matches.points - ends[0], ends[1] - ends[0]), axis=1)
    np.testing.assert_allclose(along, 0, atol=1e-12)
    np.testing.assert_allclose(matches.points[[0, -1]], ends, atol=1e-12)
    ends_only, _ = matches_from_picks(room.scan, [pick])
    np.testing.assert_allclose(ends_only.points, ends, atol=1e-12)
    for wrong in ([1.0], [1.0, -1.0], [np.nan, 1.0]):
        with pytest.raises(ShapeError):
            replace(pick, lengths_m=np.array(wrong))


def test_exports_of_what_was_read_are_version_2_and_read_the_same(
    tmp_path: Path, room: PaintedRoom, targets: tuple[FloatArray, FloatArray]
) -> None:
    picks = read_matches(written(tmp_path / "t.csv", *targets), room.scan)
    write_matches(tmp_path / "m.json", picks)
    document = json.loads((tmp_path / "m.json").read_text(encoding="utf-8"))
    assert (document["version"], document["scan_coordinates"], document["frame"]) == (2, "point", "scanner")
    for before, after in zip(picks, read_matches(tmp_path / "m.json", room.scan), strict=True):
        assert before.lengths_m is not None
        assert after.lengths_m is not None
        assert before.name == after.name
        np.testing.assert_allclose(after.lengths_m, before.lengths_m, rtol=1e-15)
        np.testing.assert_allclose(after.scan, before.scan, atol=1e-15)
