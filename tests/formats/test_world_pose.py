"""Where the scanner stands: poses in scans and pose files, and what is derived from them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ladarreg_core.errors import FormatError, LadarregError, ShapeError
from ladarreg_core.export.json import registration_document
from ladarreg_core.formats import describe, read_scan
from ladarreg_core.formats.documents.pose_file import read_initial, write_pose
from ladarreg_core.formats.scans.npz import write_npz_xyz
from ladarreg_core.frames import Rigid, describe_direction, describe_position
from ladarreg_core.scan import Scan
from testing.scenes.small_registration import sample_registration

UTM = Rigid.from_rotvec([0.004, -0.003, 2.1], (500_123.4567, 5_412_345.6789, 102.3456))
"""A scanner that is almost upright, in the coordinates of a survey."""


def arrays(scan: Scan) -> dict[str, Any]:
    return {"xyz": scan.points, "intensity": scan.intensity}


def test_a_pose_and_all_rays_are_read_kept_and_written_again(tmp_path: Path, wall: Scan) -> None:
    rays = wall.rays * np.random.default_rng(3).uniform(0.5, 2, wall.shape)[..., None]
    np.savez(tmp_path / "a.npz", rays=rays, world_from_scanner=UTM.matrix, **arrays(wall))
    scan = read_scan(tmp_path / "a.npz")
    assert not scan.valid.all()
    np.testing.assert_allclose(scan.rays, wall.rays, atol=1e-7)  # also where there is no return
    write_npz_xyz(tmp_path / "b.npz", scan)
    again = read_scan(tmp_path / "b.npz")
    for found in (scan, again):
        assert found.world_from_scanner is not None
        np.testing.assert_array_equal(found.world_from_scanner.translation, UTM.translation)  # to the bit
        np.testing.assert_allclose(found.world_from_scanner.rotation, UTM.rotation, atol=1e-15)
    np.testing.assert_allclose(again.rays, wall.rays, atol=2e-7)
    np.savez(tmp_path / "c.npz", **arrays(wall))
    assert read_scan(tmp_path / "c.npz").world_from_scanner is None


def test_rays_replace_the_angles_of_counts(tmp_path: Path, wall: Scan) -> None:
    counts = np.where(wall.valid, 1000 * np.nan_to_num(wall.ranges), 0).astype(np.uint16)
    scalars = {"r0_m": 0.0, "dr_m": 0.001, "d_azimuth_rad": 0.01, "d_elevation_rad": 0.01}
    np.savez(tmp_path / "a.npz", counts=counts, intensity=wall.intensity, rays=wall.rays, **scalars)
    scan = read_scan(tmp_path / "a.npz")
    np.testing.assert_allclose(scan.rays, wall.rays, atol=1e-12)
    np.testing.assert_allclose(scan.ranges[scan.valid], counts[scan.valid] / 1000, rtol=1e-6)


MIRRORED = np.diag([1.0, 1.0, -1.0, 1.0])
SCALED = np.diag([1.1, 1.1, 1.1, 1.0])
FAR = Rigid(np.eye(3), np.array([1e12, 0, 0])).matrix


@pytest.mark.parametrize(
    ("matrix", "word"),
    [
        (MIRRORED, "reflection"), (SCALED, "without scale"), (UTM.matrix.T, "last row"), (FAR, "check its unit"),
        (np.full((4, 4), np.nan), "rigid"), (np.eye(3), r"\(3, 3\)"), (np.eye(4) == 1, None),
    ],
)  # fmt: skip
def test_what_is_no_rigid_transformation_is_refused(tmp_path: Path, wall: Scan, matrix: Any, word: str | None) -> None:
    np.savez(tmp_path / "a.npz", world_from_scanner=matrix, **arrays(wall))
    if word is None:  # any numeric type
        assert read_scan(tmp_path / "a.npz").world_from_scanner is not None
        return
    with pytest.raises((FormatError, ShapeError), match=word) as refused:
        read_scan(tmp_path / "a.npz")
    assert "world_from_scanner" in str(refused.value)
    assert "\n" not in str(refused.value)


def test_rounded_rotations_are_taken_and_made_exact(tmp_path: Path, wall: Scan) -> None:
    np.savez(tmp_path / "a.npz", world_from_scanner=np.round(UTM.matrix, 5), **arrays(wall))
    pose = read_scan(tmp_path / "a.npz").world_from_scanner
    assert pose is not None
    np.testing.assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-15)
    assert pose.angle_to(UTM) < 2e-5


def test_rays_of_other_points_are_refused(tmp_path: Path, wall: Scan) -> None:
    np.savez(tmp_path / "a.npz", rays=wall.rays[:, ::-1], **arrays(wall))
    with pytest.raises(FormatError, match="do not lie on their 'rays'"):
        read_scan(tmp_path / "a.npz")


def test_e57_poses_are_described_and_odd_ones_are_named(tmp_path: Path, make: Any, wall: Scan) -> None:
    half = np.sqrt(0.5)
    fields = [make.e57_fields(wall)]
    good = make.e57(tmp_path / "a.e57", fields, rotation=[half, 0, 0, half], translation=[500_123.4567, 5e6, 3.0])
    info = describe(good)
    assert info.world["position"] == "X 500123.457, Y 5000000.000, Z 3.000 m"
    assert info.world["heading"] == "the scanner's X axis points 0.00 deg clockwise from the Y axis, 0.00 deg up"
    assert "500123.457, 5000000.000, 3.000 m" in info.scans[0]
    first = make.e57(tmp_path / "first.e57", fields, rotation=[1, 0, 0, 0], translation=[0.0, 0.0, 0.0])
    pose = read_scan(first).world_from_scanner
    assert pose is not None  # the first scan of a survey is often its origin
    np.testing.assert_array_equal(pose.matrix, np.eye(4))
    long = make.e57(tmp_path / "b.e57", fields, rotation=[2 * half, 0, 0, 2 * half], translation=[1.0, 2.0, 3.0])
    scan = read_scan(long)
    assert scan.world_from_scanner is not None
    assert any("length 2 instead of 1" in note for note in scan.notes)
    none = make.e57(tmp_path / "c.e57", fields, rotation=[0, 0, 0, 0], translation=[1.0, 2.0, 3.0])
    scan = read_scan(none)
    assert scan.world_from_scanner is None
    assert any("is ignored" in note for note in scan.notes)


def test_directions_and_positions_are_readable() -> None:
    assert describe_position((5_412_345.67891, -0.0001, 1e-9)) == "X 5412345.679, Y -0.000, Z 0.000 m"
    assert describe_direction((1, 0, 0)) == "90.00 deg clockwise from the Y axis, 0.00 deg up"
    assert describe_direction((-1, 0, -1)) == "270.00 deg clockwise from the Y axis, 45.00 deg down"
    assert describe_direction((-1e-7, 1, 0)).startswith("0.00 deg")  # not 360
    assert describe_direction((0, 0, -2)) == "straight down"


def test_results_state_the_camera_in_the_world_exactly(tmp_path: Path) -> None:
    result = replace(sample_registration(), world_from_scanner=UTM)
    found = registration_document(result)
    from_world, from_scanner = np.array(found["camera_from_world"]), np.array(found["camera_from_scanner"])
    # by hand, with integers of picometres: the centre of the camera carried into the world
    centre = UTM.rotation @ (-from_scanner[:3, :3].T @ from_scanner[:3, 3]) + UTM.translation
    np.testing.assert_array_equal(np.array(found["world_from_scanner"])[:3, 3], UTM.translation)
    np.testing.assert_allclose(found["camera_centre_world"], centre, rtol=0, atol=1e-9)
    np.testing.assert_allclose(from_world[:3, :3] @ centre + from_world[:3, 3], 0, atol=5e-9)
    single = np.array(found["camera_centre_world"], np.float32).astype(float)  # control: single precision fails
    assert np.abs(single - centre).max() > 0.01
    alone = registration_document(sample_registration())
    assert [alone[name] for name in ("world_from_scanner", "camera_from_world", "camera_centre_world")] == [None] * 3


def test_initial_poses_may_be_given_in_the_world(tmp_path: Path) -> None:
    camera = sample_registration().camera_from_scanner
    in_world = tmp_path / "world.json"
    in_world.write_text(json.dumps({"camera_from_world": (camera @ UTM.inverse).matrix.tolist()}), encoding="utf-8")
    found = read_initial(in_world, UTM)
    assert found.distance_to(camera) < 1e-8
    assert found.angle_to(camera) < 1e-12
    with pytest.raises(LadarregError, match="does not say where the scanner stands"):
        read_initial(in_world, None)
    assert "X " in describe(in_world).pose["in_the_world"]
    write_pose(tmp_path / "own.json", camera)
    np.testing.assert_array_equal(read_initial(tmp_path / "own.json", None).matrix, camera.matrix)


def test_a_result_of_another_scan_of_the_survey_is_carried_through_the_world(tmp_path: Path) -> None:
    first = replace(sample_registration(), world_from_scanner=UTM)
    path = tmp_path / "registration.json"
    path.write_text(json.dumps(registration_document(first)), encoding="utf-8")
    np.testing.assert_array_equal(read_initial(path, UTM).matrix, first.camera_from_scanner.matrix)
    np.testing.assert_array_equal(read_initial(path, None).matrix, first.camera_from_scanner.matrix)
    elsewhere = Rigid.from_rotvec([0, 0, 0.4], np.add(UTM.translation, (3, -2, 0.1)))
    found = read_initial(path, elsewhere)
    centre = elsewhere @ found.centre
    assert first.camera_centre_world is not None
    np.testing.assert_allclose(centre, first.camera_centre_world, atol=5e-9)
    assert found.distance_to(first.camera_from_scanner) > 1
