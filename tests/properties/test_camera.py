"""Laws of the camera model; lenses of every form, folding ones among them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from ladarreg_core.camera import Camera
from ladarreg_core.errors import CameraError

# The two lenses of a real time-of-flight camera: rational polynomials, the second with alternating signs.
DEPTH = Camera(
    640, 576, 504.6076, 504.7325, 332.7811, 348.8297,
    (0.547940, -0.0209714, 2.0557543e-05, -7.210416e-05, -0.00265223, 0.88967907, 0.08613021, -0.01391038),
)  # fmt: skip
COLOR = Camera(
    1280, 720, 611.7953, 611.9270, 639.3043, 365.8529,
    (0.33012131, -2.48939657, -1.6178245e-04, -1.2944525e-04, 1.45367086, 0.20891208, -2.30291510, 1.37512755),
)  # fmt: skip
IDEAL = Camera(768, 512, 974.0, 970.0, 383.5, 255.5)
MILD = Camera(1920, 1200, 1450.0, 1452.0, 960.2, 611.9, (-0.11, 0.08, 0.0007, -0.0004))
FIVE = Camera(1024, 768, 700.0, 705.0, 520.0, 380.0, (-0.28, 0.12, -0.001, 0.0005, -0.03))
CAMERAS = {"ideal": IDEAL, "four": MILD, "five": FIVE, "depth": DEPTH, "colour": COLOR}
cameras = pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)


def pixels(camera: Camera) -> st.SearchStrategy[np.ndarray]:
    """Pixels (8, 2) anywhere in the picture, its borders included."""
    scale = np.array([camera.width - 1, camera.height - 1])
    return hnp.arrays(np.float64, (8, 2), elements=st.floats(0, 1)).map(lambda unit: unit * scale)


def opencv_pixels(camera: Camera, points: np.ndarray) -> np.ndarray:
    uv, _ = cv2.projectPoints(
        points.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), camera.matrix, np.asarray(camera.distortion or [0.0] * 4)
    )
    return uv.reshape(-1, 2)


@pytest.mark.slow
@cameras
@given(data=st.data(), depth=st.floats(0.05, 100))
def test_a_pixel_goes_out_and_comes_back(camera: Camera, data: st.DataObject, depth: float) -> None:
    uv = data.draw(pixels(camera))
    rays = camera.unproject(uv)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1, atol=1e-14)
    np.testing.assert_allclose(camera.project(rays * depth), uv, atol=1e-7)


@pytest.mark.slow
@cameras
@given(data=st.data(), depth=st.floats(0.05, 100))
def test_projection_is_that_of_opencv(camera: Camera, data: st.DataObject, depth: float) -> None:
    points = camera.unproject(data.draw(pixels(camera))) * depth
    np.testing.assert_allclose(camera.project(points), opencv_pixels(camera, points), atol=1e-7)


@cameras
@given(data=st.data(), depth=st.floats(0.3, 20))
def test_the_jacobian_is_that_of_differences(camera: Camera, data: st.DataObject, depth: float) -> None:
    points = camera.unproject(data.draw(pixels(camera))) * depth
    uv, jacobian = camera.project_with_jacobian(points)
    np.testing.assert_allclose(uv, camera.project(points), atol=1e-9)
    step = 1e-6 * depth
    for axis in range(3):
        shift = np.eye(3)[axis] * step
        differences = (opencv_pixels(camera, points + shift) - opencv_pixels(camera, points - shift)) / (2 * step)
        scale = np.abs(jacobian).max()
        np.testing.assert_allclose(jacobian[..., axis], differences, atol=2e-6 * scale)


@cameras
def test_the_whole_picture_unprojects_within_a_thousandth_of_a_pixel(camera: Camera) -> None:
    v, u = np.mgrid[0 : camera.height : 7, 0 : camera.width : 7].astype(np.float64)
    uv = np.stack([u, v], axis=-1)
    rays = camera.unproject(uv)
    assert np.isfinite(rays).all()
    np.testing.assert_allclose(opencv_pixels(camera, rays), uv.reshape(-1, 2), atol=1e-3)


@given(hnp.arrays(np.float64, (20, 3), elements=st.floats(-1e6, 1e6)))
def test_any_point_gives_a_pixel_or_nan_and_never_a_warning(points: np.ndarray) -> None:
    for camera in CAMERAS.values():
        uv = camera.project(points)
        assert np.isnan(uv[points[:, 2] <= 0]).all()
        if camera is IDEAL:
            assert np.isfinite(uv[points[:, 2] > 1e-6]).all()


@cameras
def test_what_is_not_a_number_stays_not_a_number(camera: Camera) -> None:
    bad = np.array([[np.nan, 0, 1], [0, 0, np.nan], [0, 0, 0], [0, 0, -1], [np.inf, 0, 1]])
    assert not np.isfinite(camera.project(bad)).all(axis=-1).any()
    assert np.isnan(camera.unproject([[np.nan, 3.0]])).all()
    assert camera.contains(camera.project(bad)).sum() == 0


def test_a_lens_that_folds_shows_nothing_twice() -> None:
    """With k1 < 0 the polynomial turns back: a point far off the axis must not come back into the picture."""
    camera = Camera(640, 480, 400, 400, 319.5, 239.5, (-0.3, 0.0, 0.0, 0.0))
    angle = np.linspace(0, np.deg2rad(85), 2000)
    points = np.stack([np.sin(angle), np.zeros_like(angle), np.cos(angle)], axis=-1)
    u = camera.project(points)[:, 0]
    seen = np.isfinite(u)
    assert (np.diff(u[seen]) > 0).all()
    fold = np.arctan(1 / np.sqrt(0.9))  # d/dr (r - .3 r^3) = 0
    assert angle[seen].max() == pytest.approx(fold, abs=2e-3)
    assert not seen[angle > fold + 2e-3].any()
    beyond = camera.cx + camera.fx * (2 / 3) * np.tan(fold) + 1
    assert np.isnan(camera.unproject([beyond, camera.cy])).all()


@cameras
def test_float32_stays_float32_within_a_hundredth_of_a_pixel(camera: Camera) -> None:
    v, u = np.mgrid[0 : camera.height : 31, 0 : camera.width : 31].astype(np.float64)
    points = camera.unproject(np.stack([u, v], axis=-1)) * 4
    uv = camera.project(points.astype(np.float32))
    assert uv.dtype == np.float32
    assert uv.shape == (*u.shape, 2)
    np.testing.assert_allclose(uv, camera.project(points), atol=1e-2)


@cameras
@given(factor=st.floats(0.1, 3))
def test_a_resized_picture_keeps_its_borders(camera: Camera, factor: float) -> None:
    """Resizing by area maps the outer border of the picture, half a pixel outside, onto the new outer border."""
    small = camera.scaled(factor)
    rays = camera.unproject([[-0.5, -0.5], [camera.width - 0.5, camera.height - 0.5]])
    expected = [[-0.5, -0.5], [small.width - 0.5, small.height - 0.5]]
    keep = np.isfinite(rays).all(axis=-1)
    np.testing.assert_allclose(small.project(rays)[keep], np.array(expected)[keep], atol=1e-6)


def test_a_focal_length_alone_puts_the_principal_point_in_the_middle() -> None:
    camera = Camera.from_focal(768, 512, 974.0)
    assert (camera.cx, camera.cy, camera.fx, camera.fy) == (383.5, 255.5, 974.0, 974.0)
    np.testing.assert_allclose(camera.unproject([383.5, 255.5]), [0, 0, 1])


def test_zero_distortion_is_no_distortion() -> None:
    assert Camera(8, 6, 5, 5, 3.5, 2.5, (0.0, 0.0, 0.0, 0.0)) == Camera(8, 6, 5, 5, 3.5, 2.5)


@given(uv=st.tuples(st.floats(-20, 20), st.floats(-20, 20)), border=st.floats(0, 3))
def test_contains_is_the_rectangle_of_pixel_centres(uv: tuple[float, float], border: float) -> None:
    camera = Camera(12, 9, 5, 5, 5.5, 4)
    u, v = uv
    assert camera.contains(uv, border=border) == (border <= u <= 11 - border and border <= v <= 8 - border)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"fx": 0.0}, "fx"),
        ({"fy": -1.0}, "fy"),
        ({"fx": float("nan")}, "fx"),
        ({"cx": float("inf")}, "cx"),
        ({"width": 0}, "width"),
        ({"height": -3}, "height"),
        ({"width": 10.5}, "width"),
        ({"width": True}, "width"),
        ({"width": float("nan")}, "width"),
        ({"height": float("inf")}, "height"),
        ({"width": "wide"}, "width"),
        ({"fx": "long"}, "fx"),
        ({"fx": None}, "fx"),
        ({"distortion": (0.1,)}, "distortion"),
        ({"distortion": (0.1, float("nan"), 0, 0)}, "distortion"),
        ({"distortion": ("a", 0, 0, 0)}, "distortion"),
        ({"distortion": (0.0,) * 14}, "distortion"),
        ({"distortion": 3.0}, "distortion"),
    ],
)
def test_an_impossible_camera_is_refused_by_name(change: dict[str, object], word: str) -> None:
    good: dict[str, object] = {"width": 640, "height": 480, "fx": 500.0, "fy": 500.0, "cx": 319.5, "cy": 239.5}
    Camera(**good)  # type: ignore[arg-type]
    with pytest.raises(CameraError, match=word) as caught:
        Camera(**{**good, **change})  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)
