"""Self-calibration: a wrong focal length or k1 is estimated with the pose; a correct camera is kept."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ladarreg_core.camera import Camera
from ladarreg_core.camera.uncertainty import CALIBRATED_CAMERA_PRIOR, DEFAULT_CAMERA_PRIOR
from ladarreg_core.errors import OptionError
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.matching.auto_options import AutoOptions
from ladarreg_core.matching.images.photo_levels import photo_levels, working_camera
from ladarreg_core.matching.images.scan_levels import scan_levels
from ladarreg_core.matching.refine.aligner import Aligner
from ladarreg_core.matching.refine.covariance import RegionEvidence
from ladarreg_core.matching.refine.ecc import NO_CHANGE, CameraChange, _jacobian
from ladarreg_core.matching.refine.finished_pose import FinishedPose
from ladarreg_core.matching.refine.self_calibration import estimate_camera, verify_finished
from ladarreg_core.matching.verify.verification import GateOptions
from ladarreg_core.photo import Photo
from ladarreg_core.surface.perspective import perspective_view
from testing.scenes.painted_room import PaintedRoom, painted_room

LENS = (-0.12, 0.0, 0.0, 0.0)
changes = st.builds(CameraChange, st.floats(-0.2, 0.2), st.floats(-0.2, 0.2))


@pytest.fixture(scope="module")
def room() -> PaintedRoom:
    return painted_room(seed=5, distortion=LENS)


def finished_with(room: PaintedRoom, camera: Camera) -> tuple[FinishedPose, Photo]:
    """Return the room registered from the true pose with the stated camera, and its photo."""
    photo = Photo(room.photo.pixels, camera)
    working = working_camera(room.scan, camera)
    levels = scan_levels(room.scan, perspective_view(room.scan, working))
    aligner = Aligner(levels, photo_levels(photo, working), gate=GateOptions(), seed=0)
    candidate = aligner.refine(room.camera_from_scanner)
    assert candidate is not None
    return verify_finished(aligner, camera, aligner.finish(candidate.camera_from_scanner)), photo


@pytest.mark.slow
def test_a_correct_camera_is_kept(room: PaintedRoom) -> None:
    fixed, photo = finished_with(room, room.photo.camera)
    assert estimate_camera(fixed, photo, fixed.camera_from_scanner, "auto", DEFAULT_CAMERA_PRIOR) is fixed
    assert not fixed.camera_sigmas
    assert fixed.regions is not None
    assert room.mahalanobis(fixed.camera_from_scanner, fixed.regions.covariance) < 4
    assert np.linalg.eigvalsh(fixed.regions.covariance).min() > 0


@pytest.mark.slow
@pytest.mark.parametrize(("focal_factor", "lens"), [(1.05, LENS), (0.95, ())])
def test_a_wrong_camera_is_estimated(room: PaintedRoom, focal_factor: float, lens: tuple[float, ...]) -> None:
    true = room.photo.camera
    stated = replace(true, fx=true.fx * focal_factor, fy=true.fy * focal_factor, distortion=lens)
    fixed, photo = finished_with(room, stated)
    found = estimate_camera(fixed, photo, fixed.camera_from_scanner, "auto", DEFAULT_CAMERA_PRIOR)
    assert found.verification.accepted, found.verification.reasons
    assert abs(found.camera.fx / true.fx - 1) < 0.01
    assert abs(found.camera.distortion[0] - LENS[0]) < 0.03
    points = room.scan.points[room.scan.valid][::23].astype(float)
    expected = true.project(room.camera_from_scanner @ points)
    seen = true.contains(expected)
    off = expected - found.camera.project(found.camera_from_scanner @ points)
    assert np.median(np.hypot(*off[seen].T)) < 0.5
    z = [
        (found.camera.focal_px - true.focal_px) / found.camera_sigmas["focal_px"],
        (found.camera.distortion[0] - LENS[0]) / found.camera_sigmas["k1"],
    ]
    assert np.abs(z).max() < 4
    assert len(found.summary(stated)) == 2


def test_a_fixed_camera_is_never_changed(room: PaintedRoom) -> None:
    true = room.photo.camera
    fixed, photo = finished_with(room, replace(true, fx=true.fx * 1.05, fy=true.fy * 1.05))
    assert estimate_camera(fixed, photo, fixed.camera_from_scanner, "fixed", DEFAULT_CAMERA_PRIOR) is fixed
    only_focal = estimate_camera(fixed, photo, fixed.camera_from_scanner, "focal", DEFAULT_CAMERA_PRIOR)
    assert list(only_focal.camera_sigmas) == ["focal_px"]
    assert only_focal.camera.distortion == true.distortion
    assert abs(only_focal.camera.fx / true.fx - 1) < 0.01


def test_a_very_wrong_focal_length_is_estimated_or_refused(room: PaintedRoom) -> None:
    true = room.photo.camera
    fixed, photo = finished_with(room, replace(true, fx=true.fx * 1.2, fy=true.fy * 1.2))
    found = estimate_camera(fixed, photo, fixed.camera_from_scanner, "auto", DEFAULT_CAMERA_PRIOR)
    assert not found.verification.accepted or abs(found.camera.fx / true.fx - 1) < 0.01
    assert found.verification.reasons


@settings(max_examples=50, deadline=None)
@given(change=changes, terms=st.sampled_from([0, 4, 5, 8]))
def test_a_changed_camera_keeps_its_model(change: CameraChange, terms: int) -> None:
    camera = Camera(640, 480, 700.0, 710.0, 320.0, 241.0, tuple(0.01 * (k + 1) for k in range(terms)))
    changed = change.applied_to(camera)
    assert len(changed.distortion) in ((0, 4) if terms == 0 else (terms,))
    assert changed.distortion[1:] == (camera.distortion[1:] or (0.0,) * (len(changed.distortion) - 1))
    assert changed.fx / camera.fx == pytest.approx(np.exp(change.log_focal))
    assert changed.fy / changed.fx == pytest.approx(camera.fy / camera.fx)
    assert (changed.cx, changed.cy) == (camera.cx, camera.cy)
    assert NO_CHANGE.applied_to(camera) == camera
    there_and_back = change.after(np.array([-change.log_focal, -change.k1]))
    assert (there_and_back.log_focal, there_and_back.k1) == pytest.approx((0, 0))


@settings(max_examples=50, deadline=None)
@given(change=changes, seed=st.integers(0, 2**31))
def test_the_jacobian_is_the_derivative_of_the_projection(change: CameraChange, seed: int) -> None:
    rng = np.random.default_rng(seed)
    camera = Camera(640, 480, 700.0, 700.0, 320.0, 240.0)
    points = rng.uniform([-0.5, -0.4, 1.5], [0.5, 0.4, 4.0], (20, 3))
    step = 1e-5 * rng.normal(size=8)

    def seen(sign: float) -> np.ndarray:
        moved = Rigid(rotation_from_rotvec(sign * step[:3]), sign * step[3:6]) @ points
        return change.after(sign * step[6:]).applied_to(camera).project(moved)

    Ju, Jv = _jacobian(points, change.applied_to(camera), 2)
    expected = (seen(1) - seen(-1)) / 2
    np.testing.assert_allclose(np.stack([step @ Ju, step @ Jv], axis=-1), expected, atol=1e-4 * np.abs(expected).max())


def test_the_normal_deviate_is_normal_under_the_null_hypothesis() -> None:
    rng = np.random.default_rng(3)
    regions, deviates = 20, []
    for _ in range(2000):
        shares = rng.normal(size=(regions, 2)) @ np.array([[1.0, 0.7], [0.0, 0.5]])
        covariance = np.eye(8)
        covariance[6:, 6:] = np.cov(shares.T) / regions
        deviates.append(RegionEvidence(covariance, regions).normal_deviate(shares.mean(axis=0)))
    assert abs(np.mean(deviates)) < 0.1
    assert abs(np.std(deviates) - 1) < 0.1
    assert np.mean(np.array(deviates) > 3) < 0.005


@given(seed=st.integers(0, 2**31), sigmas=st.floats(0.01, 100))
def test_the_enlarged_covariance_covers_the_shift(seed: int, sigmas: float) -> None:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(6, 6)) + 3 * np.eye(6)
    covariance, way = root @ root.T, rng.normal(size=6)
    moved = sigmas * root @ (way / np.linalg.norm(way))
    wider = RegionEvidence(covariance, 20).inflated_by(moved).covariance
    assert np.linalg.eigvalsh(wider - covariance).min() > 0
    assert moved @ np.linalg.solve(wider, moved) <= 1
    # An error of the same length in any other direction is covered as well.
    other = sigmas * root @ np.linalg.qr(np.column_stack([way, rng.normal(size=6)]))[0][:, 1]
    assert other @ np.linalg.solve(wider, other) <= 6


@pytest.mark.slow
@pytest.mark.parametrize("focal_factor", [1.015, 0.985])
def test_a_slightly_wrong_camera_is_detected_by_the_preview(room: PaintedRoom, focal_factor: float) -> None:
    true = room.photo.camera
    fixed, photo = finished_with(room, replace(true, fx=true.fx * focal_factor, fy=true.fy * focal_factor))
    found = estimate_camera(fixed, photo, fixed.camera_from_scanner, "auto", DEFAULT_CAMERA_PRIOR)
    assert found.free
    assert abs(found.camera.fx / true.fx - 1) < 0.005


def test_an_unknown_option_is_refused() -> None:
    with pytest.raises(OptionError, match="focal_k1"):
        AutoOptions(intrinsics="everything")  # type: ignore[arg-type]


def test_a_calibrated_camera_that_the_images_contradict_is_refused_and_not_replaced(room: PaintedRoom) -> None:
    true = room.photo.camera
    fixed, photo = finished_with(room, replace(true, fx=true.fx * 1.04, fy=true.fy * 1.04))
    calibrated = replace(photo, calibrated=True)
    found = estimate_camera(fixed, calibrated, fixed.camera_from_scanner, "auto", CALIBRATED_CAMERA_PRIOR)
    assert not found.verification.accepted
    assert found.camera == photo.camera
    assert "contradict the calibrated camera" in found.verification.reasons[-1]
    named = re.search(r"focal length of ([\d.]+)", found.verification.reasons[-1])
    assert named is not None
    assert float(named[1]) == pytest.approx(true.fx, rel=0.02), "the camera that would fit is named"


def test_a_calibrated_camera_is_kept_within_what_its_calibration_knows(room: PaintedRoom) -> None:
    true = room.photo.camera
    fixed, photo = finished_with(room, replace(true, fx=true.fx * 1.002, fy=true.fy * 1.002))
    calibrated = replace(photo, calibrated=True)
    found = estimate_camera(fixed, calibrated, fixed.camera_from_scanner, "auto", CALIBRATED_CAMERA_PRIOR)
    assert found.verification.accepted
    assert found.camera == photo.camera


@pytest.mark.parametrize("focal_factor", [1.03, 0.97, 1.0])
def test_an_assumed_camera_is_estimated_with_the_pose_and_both_are_right_within_their_sigmas(
    room: PaintedRoom, focal_factor: float
) -> None:
    true = room.photo.camera
    stated = Camera.from_focal(true.width, true.height, true.fx * focal_factor)
    fixed, photo = finished_with(room, stated)
    assumed = replace(photo, assumed=True)
    found = estimate_camera(fixed, assumed, fixed.camera_from_scanner, "auto", DEFAULT_CAMERA_PRIOR)
    assert found.verification.accepted, found.verification.reasons
    joint = found.camera_uncertainty(stated)
    assert joint is not None
    assert joint.names == ("focal_px", "k1", "cx", "cy")
    assert room.mahalanobis(found.camera_from_scanner, joint.covariance[:6, :6]) < 4
    for name, value in (("focal_px", true.focal_px), ("k1", LENS[0]), ("cx", true.cx), ("cy", true.cy)):
        now = found.camera.focal_px if name == "focal_px" else found.camera.distortion[0] if name == "k1" else None
        now = getattr(found.camera, name) if now is None else now
        assert abs(now - value) < 4 * joint.sigmas[name]
        assert joint.sigmas[name] < joint.prior.get(name, np.inf), "the images add to what was known"
