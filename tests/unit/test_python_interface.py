"""The Python interface: scans and photographs of arrays, transforms, texts of results, matches of one's own."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import ladarreg_core as lr
from ladarreg_core.errors import OptionError, ShapeError, UnderspecifiedError
from ladarreg_core.formats.documents.registration_file import read_registration
from ladarreg_core.scanner.grids import AzimuthElevation
from ladarreg_core.simulate import SimulatedCase
from testing.scenes.simulated import simulated


@pytest.fixture(scope="module")
def case() -> SimulatedCase:
    return simulated("boxes")


@pytest.fixture(scope="module")
def accepted(case: SimulatedCase) -> lr.Registration:
    cells, uv = true_matches(case, 60, seed=1)
    return lr.register(case.scan, case.photo, uv=uv, cells=cells)


def true_matches(case: SimulatedCase, count: int, *, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return cells (M, 2) and pixels (M, 2), with noise of half a pixel, of returns that the photograph shows."""
    rng = np.random.default_rng(seed)
    labels = lr.texture_scan(case.scan, case.photo, case.camera_from_scanner).labels
    cells = rng.permutation(np.argwhere(labels == lr.Label.SEEN))[:count]
    points = case.scan.points[cells[:, 0], cells[:, 1]].astype(np.float64)
    uv = case.photo.camera.project(case.camera_from_scanner @ points)
    return cells.astype(np.float64), uv + rng.normal(0, 0.5, uv.shape)


@pytest.mark.slow
def test_points_become_the_scan_they_were_taken_from(case: SimulatedCase) -> None:
    scan = case.scan.thinned(40_000)[0]
    points = scan.points[scan.valid].astype(np.float64)
    away = np.array([12.0, -3.0, 1.5])
    made = lr.Scan.from_points(points + away, scan.intensity[scan.valid], origin=away, name="cloud")
    assert made.world_from_scanner is not None
    np.testing.assert_allclose(made.world_from_scanner.translation, away)
    found = made.points[made.valid]
    assert len(found) > 0.95 * len(points)
    distance = cKDTree(found).query(points[::97])[0]
    assert np.median(distance) < 1e-3
    with pytest.raises(ShapeError, match="12"):
        lr.Scan.from_points(points[:5])
    with pytest.raises(ShapeError, match="colours"):
        lr.Scan.from_points(points, colors=np.zeros((3, 3), np.uint8))


def test_an_unknown_origin_is_asked_for_by_its_name() -> None:
    rng = np.random.default_rng(0)
    with pytest.raises(UnderspecifiedError, match="`origin`"):
        lr.Scan.from_points(rng.normal(0, 3, (4000, 3)) + 5000, origin=None)


def test_intensity_may_be_left_out(case: SimulatedCase) -> None:
    points = case.scan.thinned_points(10).reshape(-1, 3)
    dark = lr.Scan.from_points(points)
    assert not dark.intensity.any()
    assert "no intensity" in dark.notes[0]
    colors = np.full((len(points), 3), (255, 0, 0), np.uint8)
    red = lr.Scan.from_points(points, colors=colors)
    assert red.intensity[red.valid] == pytest.approx(255 * 0.2126)
    assert "luminance" in red.notes[0]


@pytest.mark.parametrize("turn", ["as it is", "rows reversed", "columns reversed", "transposed", "all"])
def test_a_grid_in_any_order_is_put_upright(case: SimulatedCase, turn: str) -> None:
    scan = case.scan.thinned(20_000)[0]
    xyz, light = np.array(scan.points), np.array(scan.intensity)
    xyz[3, 4] = np.nan
    if turn in ("rows reversed", "all"):
        xyz, light = xyz[::-1], light[::-1]
    if turn in ("columns reversed", "all"):
        xyz, light = xyz[:, ::-1], light[:, ::-1]
    if turn in ("transposed", "all"):
        xyz, light = xyz.swapaxes(0, 1), light.T
    made = lr.Scan.from_grid(xyz, intensity=light)
    assert made.shape == scan.shape
    assert not made.valid[3, 4]
    seen = made.valid & scan.valid
    np.testing.assert_allclose(made.points[seen], scan.points[seen], atol=1e-4)
    np.testing.assert_array_equal(made.intensity[seen], scan.intensity[seen])
    assert bool(made.notes) == (turn != "as it is")


def test_ranges_with_angles_are_the_points() -> None:
    grid = AzimuthElevation(20, 30, 0.01, 0.012)
    ranges = 3 + np.random.default_rng(1).uniform(0, 0.1, grid.shape)
    xyz = grid.rays * ranges[..., None]
    azimuth = np.arctan2(grid.rays[..., 1], grid.rays[..., 0])
    elevation = np.arcsin(grid.rays[..., 2])
    by_angles = lr.Scan.from_grid(ranges=ranges, azimuth_rad=azimuth, elevation_rad=elevation)
    by_rays = lr.Scan.from_grid(ranges=ranges, rays=5 * grid.rays)
    for made in (by_angles, by_rays, lr.Scan.from_grid(xyz)):
        np.testing.assert_allclose(made.points, xyz, atol=1e-6)
    with pytest.raises(OptionError, match="give `xyz`"):
        lr.Scan.from_grid(ranges=ranges)
    with pytest.raises(ShapeError, match="azimuths"):
        lr.Scan.from_grid(ranges=ranges, azimuth_rad=azimuth[0, :3], elevation_rad=elevation)


def test_pixels_of_any_type_become_a_photo() -> None:
    gray = np.arange(12, dtype=np.uint8).reshape(3, 4) * 20
    expected = np.repeat(gray[..., None], 3, axis=2)
    arrays = (
        gray,
        gray[..., None],
        expected,
        gray.astype(np.uint16) * 257,
        gray / 255,
        (gray / 255).astype(np.float32),
    )
    for pixels in arrays:
        np.testing.assert_array_equal(lr.Photo.from_array(pixels, focal_px=5).pixels, expected)
    stretched = lr.Photo.from_array(gray.astype(float) + 100, focal_px=5, black=100, white=355)
    np.testing.assert_array_equal(stretched.pixels, expected)
    assert lr.Photo.from_array(gray, focal_mm=36, sensor_mm=36).camera.focal_px == pytest.approx(4)
    camera = lr.Camera.from_focal(4, 3, 5)
    assert lr.Photo.from_array(gray, camera=camera).calibrated
    assert lr.Photo.from_array(gray, focal_px=5).assumed
    with pytest.raises(OptionError, match="`white`"):
        lr.Photo.from_array(gray.astype(float) + 1, focal_px=5)
    with pytest.raises(OptionError, match="give one of camera"):
        lr.Photo.from_array(gray, camera=camera, focal_px=5)
    with pytest.raises(ShapeError, match=r"\(H, W, 3\)"):
        lr.Photo.from_array(np.zeros((3, 4, 2), np.uint8), focal_px=5)


@given(st.lists(st.floats(-4, 4), min_size=3, max_size=3))
def test_quaternions_agree_with_scipy_in_both_orders(rotvec: list[float]) -> None:
    pose = lr.Rigid.from_rotvec(rotvec, (1, 2, 3))
    xyzw = Rotation.from_matrix(pose.rotation).as_quat(canonical=True)
    assert abs(xyzw @ pose.quaternion_xyzw) == pytest.approx(1, abs=1e-12)
    np.testing.assert_array_equal(pose.quaternion_wxyz, pose.quaternion_xyzw[[3, 0, 1, 2]])
    for again in (
        lr.Rigid.from_quaternion_wxyz(pose.quaternion_wxyz, pose.translation),
        lr.Rigid.from_quaternion_xyzw(3 * pose.quaternion_xyzw, pose.translation),
        lr.Rigid.from_json(pose.to_json()),
    ):
        np.testing.assert_allclose(again.matrix, pose.matrix, atol=1e-12)


def test_the_wrong_order_of_a_quaternion_is_another_rotation() -> None:
    pose = lr.Rigid.from_rotvec((0.1, 0.2, 0.3))
    assert lr.Rigid.from_quaternion_wxyz(pose.quaternion_xyzw).angle_to(pose) > 0.5


@pytest.mark.parametrize(
    "camera",
    [
        lr.Camera(40, 30, 50, 51, 19, 14, (0.1, 0, 0, 0, 0.01)),
        lr.FisheyeCamera(40, 30, 15, 15, 19, 14, (0.01, 0, 0, 0)),
        lr.EquirectangularCamera(40, 20),
        lr.EquirectangularCamera(40, 20, (-90, 45, 90, -45)),
    ],
)
def test_cameras_go_through_json(camera: lr.Camera) -> None:
    assert lr.camera_from_json(camera.to_json()) == camera


def test_a_registration_goes_through_json(accepted: lr.Registration, tmp_path: Path) -> None:
    text = accepted.to_json()
    again = lr.Registration.from_json(text)
    assert again.accepted
    assert again.evidence == accepted.evidence
    assert repr(again) == repr(accepted)
    np.testing.assert_allclose(again.camera_from_scanner.matrix, accepted.camera_from_scanner.matrix, atol=1e-12)
    for name in ("covariance", "inliers", "residuals_px", "residuals_m", "stereo_depth_error_m"):
        np.testing.assert_array_equal(getattr(again, name), getattr(accepted, name))
    for name in ("rays", "ranges", "uv", "weights", "range_weights"):
        np.testing.assert_allclose(getattr(again.matches, name), getattr(accepted.matches, name), atol=1e-15)
    (tmp_path / "r.json").write_text(text, encoding="utf-8")
    assert read_registration(tmp_path / "r.json").accepted
    refused = replace(accepted, accepted=False, evidence="none")
    assert json.loads(refused.to_json())["camera_from_scanner"] is None
    assert not lr.Registration.from_json(refused.to_json()).accepted
    with pytest.raises(ShapeError, match="not a registration"):
        lr.Registration.from_json("[1]")


def test_texts_are_one_line_with_the_verdict_first(case: SimulatedCase, accepted: lr.Registration) -> None:
    as_given = lr.given_pose(case.scan, case.photo, case.camera_from_scanner, check_images=False)
    shown = [
        case.scan, case.photo, case.photo.camera, case.camera_from_scanner, accepted, accepted.matches,
        lr.EquirectangularCamera(40, 20), as_given,
    ]  # fmt: skip
    for value in shown:
        assert "\n" not in repr(value)
        assert len(repr(value)) < 200, repr(value)
    assert repr(accepted).startswith("Registration(accepted by the images; ")
    assert " px" in repr(accepted)
    assert repr(shown[-1]).startswith("Registration(given, not verified; ")
    refused = replace(accepted, accepted=False, evidence="none")
    assert repr(refused).startswith("Registration(not accepted, best guess; ")


@pytest.mark.slow
def test_matches_of_ones_own_need_no_picks(case: SimulatedCase, accepted: lr.Registration) -> None:
    truth = case.camera_from_scanner
    cells, uv = true_matches(case, 60, seed=1)
    rays = case.scan.geometry.ray_at(cells)
    points = case.scan.points[tuple(cells.astype(int).T)]
    for made in (
        accepted,
        lr.register(case.scan, case.photo, uv=uv, rays=3 * rays),
        lr.register(case.scan, case.photo, uv=uv, points=points),
    ):
        assert made.accepted
        assert made.method == "manual"
        assert len(made.matches) > 50
        assert made.camera_from_scanner.distance_to(truth) < 0.02
    wrong = uv.copy()
    wrong[::3] = np.random.default_rng(2).uniform(0, 500, wrong[::3].shape)
    robust = lr.register(case.scan, case.photo, uv=wrong, cells=cells)
    assert robust.camera_from_scanner.distance_to(truth) < 0.03
    for bad in (
        {"uv": uv},
        {"rays": rays},
        {"uv": uv, "rays": rays, "cells": cells},
        {"uv": uv, "rays": rays, "picks": []},
    ):
        with pytest.raises(OptionError, match="either picks, or uv"):
            lr.register(case.scan, case.photo, **bad)  # type: ignore[arg-type]


def test_the_images_say_whether_a_pose_is_right(case: SimulatedCase) -> None:
    right = lr.verify_pose(case.scan, case.photo, case.camera_from_scanner)
    assert right.outcome == "verified"
    assert right.verification is not None
    assert right.verification.fraction > 0.75
    away = lr.Rigid.from_rotvec((0, np.pi, 0)) @ case.camera_from_scanner
    behind = lr.verify_pose(case.scan, case.photo, away)
    assert behind.outcome == "undecidable"
    assert "No return" in behind.sentence


def test_the_import_costs_nothing() -> None:
    code = "import sys, ladarreg_core; print([m for m in ('numpy', 'cv2', 'scipy') if m in sys.modules])"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"


def test_everything_public_can_be_reached() -> None:
    for name in lr.__all__:
        assert getattr(lr, name).__doc__, name
