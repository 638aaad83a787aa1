"""Laws that every camera model keeps, and comparisons with OpenCV where it has the model."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from ladarreg_core.camera import (
    Camera,
    CameraModel,
    EquirectangularCamera,
    FisheyeCamera,
    camera_from_model_fields,
)
from ladarreg_core.errors import CameraError

TERMS = (-0.21, 0.06, 0.001, -0.0007, 0.01, 0.02, -0.003, 0.001, 0.002, -0.001, -0.0015, 0.0005)
MODELS = [
    Camera(640, 480, 500, 510, 322, 236, TERMS),
    Camera(640, 480, 500, 510, 322, 236, TERMS[:8]),
    FisheyeCamera(1000, 1000, 300, 302, 498, 503, (0.03, -0.01, 0.004, -0.0006)),
    FisheyeCamera(1000, 1000, 290, 290, 499.5, 499.5),
    EquirectangularCamera(800, 400),
    EquirectangularCamera(640, 300, (-70.0, 40.0, 100.0, -60.0)),
    EquirectangularCamera(640, 300, (120.0, 40.0, 480.0, -60.0)),
]


def pixels_of(camera: CameraModel, count: int = 400) -> np.ndarray:
    rng = np.random.default_rng(3)
    return rng.uniform([0, 0], [camera.width - 1, camera.height - 1], (count, 2))


@pytest.mark.parametrize("camera", MODELS)
def test_projecting_the_ray_of_a_pixel_gives_the_pixel(camera: CameraModel) -> None:
    uv = pixels_of(camera)
    rays = camera.unproject(uv)
    seen = np.isfinite(rays).all(axis=-1)
    assert seen.mean() > 0.7
    assert np.allclose(np.linalg.norm(rays[seen], axis=-1), 1, atol=1e-12)
    again = camera.project(rays[seen] * 3.7)
    assert np.abs(camera.difference(again, uv[seen])).max() < 1e-6
    assert np.isnan(camera.project(np.zeros(3))).all()


@pytest.mark.parametrize("camera", MODELS)
def test_the_jacobian_is_the_derivative(camera: CameraModel) -> None:
    rays = camera.unproject(pixels_of(camera))
    points = rays[np.isfinite(rays).all(axis=-1)] * 2.3
    uv, jacobian = camera.project_with_jacobian(points)
    assert np.array_equal(uv, camera.project(points))
    step = 1e-6
    for axis in range(3):
        away = np.eye(3)[axis] * step
        slope = camera.difference(camera.project(points + away), camera.project(points - away)) / (2 * step)
        there = np.isfinite(slope).all(axis=-1) & (np.abs(jacobian).max(axis=(-1, -2)) < 1e4)
        assert there.mean() > 0.9
        assert np.abs(slope - jacobian[..., axis])[there].max() < 2e-2 * 1e-1


@pytest.mark.parametrize("camera", MODELS)
def test_a_resized_camera_keeps_the_borders(camera: CameraModel) -> None:
    uv = pixels_of(camera)
    half = camera.scaled(0.5)
    assert half.size == (camera.width / 2, camera.height / 2)
    rays = camera.unproject(uv)
    there = np.isfinite(rays).all(axis=-1)
    expected = (uv[there] + 0.5) / 2 - 0.5
    assert np.abs(half.difference(half.project(rays[there]), expected)).max() < 1e-6


@pytest.mark.parametrize("camera", MODELS)
def test_fields_give_the_same_camera(camera: CameraModel) -> None:
    assert camera_from_model_fields(camera.as_fields()) == camera


@pytest.mark.parametrize("camera", MODELS)
def test_single_precision_stays_and_agrees(camera: CameraModel) -> None:
    rays = camera.unproject(pixels_of(camera))
    points = rays[np.isfinite(rays).all(axis=-1)]
    single = camera.project(points.astype(np.float32))
    assert single.dtype == np.float32
    assert np.abs(camera.difference(single, camera.project(points))).max() < 5e-3


def test_twelve_terms_are_opencvs() -> None:
    camera = MODELS[0]
    assert isinstance(camera, Camera)
    points = np.random.default_rng(1).uniform([-1, -0.8, 1.5], [1, 0.8, 3], (200, 3))
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.matrix, np.array(TERMS))
    assert np.abs(camera.project(points) - expected[:, 0]).max() < 1e-9


def test_a_fisheye_is_opencvs_in_front_and_goes_on_beside_and_behind() -> None:
    camera = MODELS[2]
    assert isinstance(camera, FisheyeCamera)
    points = np.random.default_rng(1).uniform([-3, -3, 0.2], [3, 3, 3], (200, 3))
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    expected, _ = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), matrix, np.array(camera.distortion)
    )
    assert np.abs(camera.project(points) - expected[:, 0]).max() < 1e-9
    plain = FisheyeCamera(1000, 1000, 200, 200, 499.5, 499.5)
    for degrees in (30, 89.9, 90, 95, 120, 170):
        angle = np.radians(degrees)
        uv = plain.project(np.array([np.sin(angle), 0, np.cos(angle)]))
        assert np.allclose(uv, [499.5 + 200 * angle, 499.5], atol=1e-9)
    # The control: OpenCV's own function mirrors what lies behind the camera.
    behind = np.array([[[np.sin(2.0), 0, np.cos(2.0)]]])
    mirrored, _ = cv2.fisheye.projectPoints(behind, np.zeros(3), np.zeros(3), np.diag([200.0, 200, 1]), np.zeros(4))
    assert abs(mirrored[0, 0, 0] - 200 * 2.0) > 100


def test_a_folding_fisheye_maps_nothing_beyond_its_fold() -> None:
    camera = FisheyeCamera(1000, 1000, 300, 300, 499.5, 499.5, (-0.1, 0, 0, 0))  # slope 1 - .3 theta^2
    fold = np.sqrt(1 / 0.3)
    assert abs(camera.largest_angle_rad - fold) < 2e-3
    for angle, seen in ((fold - 0.01, True), (fold + 0.01, False)):
        assert np.isfinite(camera.project(np.array([np.sin(angle), 0, np.cos(angle)]))).all() == seen
    assert np.isnan(camera.unproject(np.array([999.0, 499.5]))).all()


def test_directions_of_a_panorama() -> None:
    camera = EquirectangularCamera(360, 180)
    middle, right, up, behind = np.array([[0, 0, 1], [1, 0, 0], [0, -1, 1e-9], [0, 0, -1]], dtype=float)
    assert np.allclose(camera.project(middle), [179.5, 89.5])
    assert np.allclose(camera.project(right), [269.5, 89.5])
    assert np.allclose(camera.project(up)[1], -0.5)
    assert camera.project(behind)[0] in (-0.5, 359.5)
    left_of_seam, right_of_seam = camera.unproject(np.array([[359.4, 89.5], [-0.4, 89.5]]))
    assert np.degrees(np.arccos(left_of_seam @ right_of_seam)) == pytest.approx(0.2, abs=1e-6)
    assert camera.difference(np.array([359.0, 5]), np.array([1.0, 5])) == pytest.approx([-2, 0])
    assert camera.contains(np.array([[-0.5, 5], [359.4, 5], [10, -0.6]])).tolist() == [True, True, False]


def test_a_window_is_not_a_full_turn() -> None:
    camera = EquirectangularCamera(100, 50, (10.0, 20.0, 60.0, -5.0))
    ray = camera.unproject(np.array([-0.5, -0.5]))
    longitude, latitude = np.degrees(np.arctan2(ray[0], ray[2])), np.degrees(np.arcsin(-ray[1]))
    assert (longitude, latitude) == pytest.approx((10, 20))
    assert not camera.contains(np.array([-0.4, 10])).any()


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"model": "omnidirectional", "width": 2, "height": 2}, "omnidirectional"),
        ({"model": "fisheye", "width": 2, "height": 2}, "lacks fx"),
        ({"model": "equirectangular", "width": 2, "height": 2, "window": [0, 1]}, "window"),
        ({"model": "equirectangular", "width": 2, "height": 2, "window": [0, -9, 10, 9]}, "window"),
        ({"model": "equirectangular", "width": 0, "height": 2}, "width"),
        ({"model": "fisheye", "width": 2, "height": 2, "fx": 1, "fy": 1, "cx": 0, "cy": 0, "distortion": [1] * 5},
         "0 or 4"),
    ],
)  # fmt: skip
def test_impossible_cameras_are_refused(fields: dict[str, object], said: str) -> None:
    with pytest.raises(CameraError, match=said):
        camera_from_model_fields(fields)
