"""Real scans with real or rendered photographs: correct pairs are accepted, wrong ones never."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.frames import look_along, rotation_from_rotvec
from ladarreg_core.matching.auto_options import AutoOptions
from ladarreg_core.quality.assessment import assess
from ladarreg_core.registration.register import RegisterOptions
from ladarreg_core.surface.visibility.render import render_scan_colors
from testing.scenes.kept import kept

pytestmark = pytest.mark.slow


def truth_of(folder: Path) -> lr.Rigid:
    return lr.Rigid.from_matrix(json.loads((folder / "truth.json").read_text())["camera_from_scanner"])


@kept
def read(file: Path) -> lr.Scan:
    return lr.read_scan(file)


def capture(folder: Path, scan: str, photo: str) -> tuple[lr.Scan, lr.Photo]:
    return read(folder / scan), lr.read_photo(folder / photo, camera=folder / "camera.json")


@pytest.fixture(scope="module")
def kinect(real_data: Path) -> tuple[lr.Scan, lr.Photo]:
    return capture(real_data / "kinect", "scan.json", "color_1.jpg")


@pytest.fixture(scope="module")
def pump(real_data: Path) -> lr.Scan:
    return read(real_data / "pump" / "pumpAVisualReferenceImage.e57")


def test_kinect_agrees_with_its_factory_calibration(kinect: tuple[lr.Scan, lr.Photo], real_data: Path) -> None:
    result = lr.register(*kinect)
    truth = truth_of(real_data / "kinect")
    assert result.accepted, result.reasons
    assert result.evidence == "image"
    # The images contradict the calibrated focal length by 1.5 %, which turns the pose by a fifth of a degree.
    assert np.degrees(result.camera_from_scanner.angle_to(truth)) <= 0.3
    assert result.camera_from_scanner.distance_to(truth) <= 0.006
    free = lr.register(*kinect, options=RegisterOptions(auto=AutoOptions(intrinsics="focal")))
    assert free.accepted, free.reasons
    assert np.degrees(free.camera_from_scanner.angle_to(truth)) <= 0.15
    assert free.camera_from_scanner.distance_to(truth) <= 0.002


@pytest.mark.long
def test_kinect_with_nothing_but_a_focal_length_states_what_is_not_known(
    kinect: tuple[lr.Scan, lr.Photo], real_data: Path
) -> None:
    """The true principal point lies 6 px off the middle: as an exact camera the pose would be 13 sigmas off."""
    photo = lr.read_photo(real_data / "kinect" / "color_1.jpg", focal_px=612)
    result = lr.register(kinect[0], photo)
    assert result.accepted, result.reasons
    off = float(result.camera_from_scanner.angle_to(truth_of(real_data / "kinect")))
    assert off / 2 < result.sigma_angle_rad < 4 * off
    uncertainty = assess(kinect[0], result).uncertainty
    assert uncertainty is not None
    assert uncertainty.median_px < 1  # the pose compensates the camera in the picture


PUMP_CAMERA = lr.Camera(width=900, height=1000, fx=700, fy=700, cx=449.5, cy=499.5)


def pump_pose(scan: lr.Scan, seed: int) -> lr.Rigid:
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=3)
    centre = direction / np.linalg.norm(direction) * rng.uniform(0.3, 0.8)
    middle = np.median(scan.points[scan.valid], axis=0)
    roll = rotation_from_rotvec([0, 0, np.deg2rad(rng.uniform(-3, 3))])
    return lr.Rigid.from_centre(roll @ look_along(middle - centre), centre)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in range(1, 5))])
def test_pump_from_another_position(pump: lr.Scan, seed: int) -> None:
    truth = pump_pose(pump, seed)
    picture, _ = render_scan_colors(pump, PUMP_CAMERA, truth)
    result = lr.register(pump, lr.Photo(picture, PUMP_CAMERA))
    assert result.accepted, result.reasons
    assert np.degrees(result.camera_from_scanner.angle_to(truth)) <= 0.12
    assert result.camera_from_scanner.distance_to(truth) <= 0.008


@pytest.mark.long
# What is known of these captures is a published calibration, itself 5 to 11 px off where it could be checked.
@pytest.mark.parametrize(
    ("name", "scan", "photo", "known_px"),
    [("garage", "scan.npz", "frame9.png", 8.0), ("street", "scan.pcd", "photo.png", 12.0)],
)
@pytest.mark.parametrize("start", ["off", "none", "truth"])
def test_sparse_captures_end_in_a_clear_verdict(
    real_data: Path, name: str, scan: str, photo: str, known_px: float, start: str
) -> None:
    pair = capture(real_data / name, scan, photo)
    truth = truth_of(real_data / name)
    off = lr.Rigid(rotation_from_rotvec([0.05, -0.08, 0.03]) @ truth.rotation, truth.translation + 0.1)
    result = lr.register(*pair, initial={"none": None, "truth": truth, "off": off}[start])
    if result.accepted:  # acceptance is allowed if the pose is correct
        points = pair[0].points[pair[0].valid].astype(float)
        true = result.camera.project(truth @ points)
        seen = result.camera.contains(true)
        error = np.hypot(*(true - result.camera.project(result.camera_from_scanner @ points))[seen].T)
        assert np.median(error) < known_px
    assert result.reasons


@pytest.mark.long
def test_photographs_of_other_places_are_refused(
    kinect: tuple[lr.Scan, lr.Photo], pump: lr.Scan, real_data: Path
) -> None:
    street = lr.read_photo(real_data / "street" / "photo.png", camera=real_data / "street" / "camera.json")
    garage = lr.read_photo(real_data / "garage" / "frame9.png", camera=real_data / "garage" / "camera.json")
    for scan, photo in ((kinect[0], street), (kinect[0], garage), (pump, kinect[1]), (pump, garage)):
        result = lr.register(scan, photo)
        assert not result.accepted
    mirrored = lr.Photo(kinect[1].pixels[:, ::-1], kinect[1].camera)
    assert not lr.register(kinect[0], mirrored).accepted
