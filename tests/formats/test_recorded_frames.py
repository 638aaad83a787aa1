"""Clouds and pictures of recordings as pairs: which belong together, which are chosen, and what is refused."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.camera import Camera, CameraModel, FisheyeCamera
from ladarreg_core.errors import CameraError, FormatError, OptionError, UnderspecifiedError
from testing.files.recordings import (
    CLOUD,
    COMPRESSED,
    IMAGE,
    INFO,
    Topics,
    camera_info,
    compressed_image,
    image,
    point_cloud,
    write_recording,
)

pytestmark = pytest.mark.skipif(importlib.util.find_spec("rosbags") is None, reason="rosbags is not installed")
S, BEGIN = 10**9, 1_700_000_000 * 10**9
SIZE = (96, 64)
CAMERA = Camera(*SIZE, 80.0, 81.0, 47.0, 32.0, (0.1, -0.05, 0.001, 0.002, 0.01))


def picture(number: int) -> np.ndarray:
    """Return smooth noise (64, 96, 3), of which every number has another."""
    rough = np.random.default_rng(number).integers(0, 256, (8, 12, 3), dtype=np.uint8)
    return np.asarray(cv2.resize(rough, SIZE, interpolation=cv2.INTER_CUBIC))


def points(number: int) -> np.ndarray:
    """Return returns of a turn of eight lines, at ranges that only this number has."""
    azimuth = np.linspace(-np.pi, np.pi, 400, endpoint=False)
    elevation = np.radians(np.linspace(-12, 12, 8))
    a, e = (grid.ravel() for grid in np.meshgrid(azimuth, elevation))
    ranges = 5.0 + number + 0.5 * np.sin(5 * a)
    return ranges[:, None] * np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1)


def clouds(numbers: dict[int, int], frame: str = "lidar") -> Any:
    """Return clouds: their numbers by the milliseconds at which they were taken."""
    made = []
    for at, number in numbers.items():
        stamp = BEGIN + at * 10**6
        made.append((stamp, point_cloud(points(number), np.ones(3200), stamp_ns=stamp, frame=frame)))
    return CLOUD, made


def pictures(numbers: dict[int, int], **options: Any) -> Any:
    """Return pictures likewise; they are recorded .4 s late."""
    made = []
    for at, number in numbers.items():
        stamp = BEGIN + at * 10**6
        made.append((stamp + 4 * 10**8, image(picture(number), stamp_ns=stamp, **options)))
    return IMAGE, made


def info(camera: CameraModel = CAMERA, **changed: Any) -> Any:
    return INFO, [(BEGIN, camera_info(camera, **changed))]


def recording(folder: Path, kind: str = "mcap", **changed: Any) -> Path:
    """Write two clouds with a picture each, and topics that replace these or are added to them; None leaves one out."""
    topics = {"/points": clouds({0: 0, 1000: 1}), "/cam/image_raw": pictures({10: 0, 1010: 1}),
              "/cam/camera_info": info()} | changed  # fmt: skip
    return write_recording(folder / "r", kind, {name: made for name, made in topics.items() if made is not None})


@pytest.mark.parametrize("kind", ["bag", "db3", "mcap"])
def test_pairs_are_of_one_moment_and_have_the_camera_of_camera_info(tmp_path: Path, kind: str) -> None:
    """Pictures at 30 Hz, and recorded late: only the time stamps tell which one belongs to a cloud."""
    every = {at: 100 + at for at in range(0, 1100, 33)} | {510: 7}
    file = recording(tmp_path, kind, **{"/points": clouds({0: 0, 508: 1, 990: 2}), "/cam/image_raw": pictures(every)})
    pairs = lr.read_rig(file)
    assert [pair.name for pair in pairs] == ["cam 0.00 s", "cam 0.51 s", "cam 0.99 s"]
    for pair, number in zip(pairs, (100, 7, 1090), strict=True):
        np.testing.assert_array_equal(pair.photo.pixels, picture(number))
        assert pair.photo.camera == CAMERA
        assert pair.photo.calibrated
    medians = [float(np.median(pair.scan.ranges[pair.scan.valid])) for pair in pairs]
    np.testing.assert_allclose(medians, [5, 6, 7], atol=0.02)
    assert any("3 clouds of /points and pictures of /cam/image_raw are pairs" in note for note in pairs[0].photo.notes)
    if kind != "bag":
        assert [pair.name for pair in lr.read_rig(file.parent)] == [pair.name for pair in pairs]


def test_pictures_that_are_too_far_apart_in_time_are_no_pairs(tmp_path: Path) -> None:
    images = pictures({at: at for at in (0, 100, 460, 1000)})
    pairs = lr.read_rig(recording(tmp_path, **{"/points": clouds({0: 0, 400: 1, 1000: 2}), "/cam/image_raw": images}))
    assert [pair.name for pair in pairs] == ["cam 0.00 s", "cam 0.40 s", "cam 1.00 s"]
    far = pictures({700: 1, 800: 2, 900: 3})
    with pytest.raises(FormatError, match=r"no picture of /cam/image_raw .* 2 from 0\.00 to 1\.00 s against 3 from"):
        lr.read_rig(recording(tmp_path / "far", **{"/cam/image_raw": far}))


def test_empty_stamps_give_way_to_the_time_of_recording(tmp_path: Path) -> None:
    late = (IMAGE, [(BEGIN + k * S + 1000, image(picture(k), stamp_ns=0)) for k in range(2)])
    pairs = lr.read_rig(recording(tmp_path, **{"/cam/image_raw": late}))
    assert len(pairs) == 2
    assert any("pairs by the time of recording" in note for note in pairs[0].photo.notes)


@pytest.mark.parametrize("deskewed", [False, True])
def test_a_few_different_places_are_chosen(tmp_path: Path, deskewed: bool) -> None:
    """The rig stands at four places for 1 s each; between two of them it moves, which every picture shows."""
    places = {at: at // 1000 for at in range(0, 4000, 100)}
    moving = {at: 50 + at for at in range(4000, 5000, 100)}
    shown = {**places, **moving, 5000: 3, 5100: 3}
    file = recording(tmp_path, **{"/points": clouds(dict.fromkeys(shown, 0)), "/cam/image_raw": pictures(shown)})
    pairs = lr.read_rig(file, frames=4, deskewed=deskewed)
    at = [float(pair.name.split()[1]) for pair in pairs]
    assert len(pairs) == 4
    assert at == sorted(at)
    if deskewed:
        assert sum(4 <= time < 5 for time in at) >= 3
    else:
        assert sorted(int(time) % 5 for time in at) == [0, 1, 2, 3]
        assert any("pictures move least" in note for note in pairs[0].photo.notes)


def test_neighbors_are_read_for_a_time_offset(tmp_path: Path) -> None:
    shown = {at: at for at in range(0, 1500, 100)}
    file = recording(tmp_path, **{"/points": clouds({400: 0, 800: 1}), "/cam/image_raw": pictures(shown)})
    pair = lr.read_rig(file, neighbors=True)[0]
    np.testing.assert_allclose([one.after_s for one in pair.taken], np.arange(-0.4, 0.61, 0.1), atol=1e-9)
    np.testing.assert_array_equal(pair.taken[0].photo.pixels, picture(0))
    assert [len(pair.taken) for pair in lr.read_rig(file)] == [1, 1]


def test_several_cameras_have_their_own_pairs_and_intrinsics(tmp_path: Path) -> None:
    fisheye = FisheyeCamera(*SIZE, 40.0, 40.0, 47.5, 31.5, (0.01, 0.002, 0.0, 0.0))
    other = {"/rear/image_raw": pictures({20: 5, 1020: 6}), "/rear/camera_info": info(fisheye)}
    file = recording(tmp_path, **other)
    with pytest.raises(UnderspecifiedError, match=r"/cam/image_raw, /rear/image_raw.*`images`"):
        lr.read_rig(file)
    pairs = lr.read_rig(file, images=["rear/image_raw", "/cam/image_raw"])
    assert [pair.camera_name for pair in pairs] == ["rear", "rear", "cam", "cam"]
    assert [pair.photo.camera for pair in pairs] == [fisheye, fisheye, CAMERA, CAMERA]
    assert {pair.camera_name for pair in lr.read_rig(file, images=["/rear/image_raw"])} == {""}


def test_compressed_pictures_are_read(tmp_path: Path) -> None:
    made = [(BEGIN + k * S, compressed_image(picture(k), stamp_ns=BEGIN + k * S, suffix=".png")) for k in range(2)]
    file = recording(tmp_path, **{"/cam/image_raw": None, "/cam/image_raw/compressed": (COMPRESSED, made)})
    pairs = lr.read_rig(file)
    np.testing.assert_array_equal(pairs[1].photo.pixels, picture(1))
    assert pairs[1].photo.camera == CAMERA
    broken = [(BEGIN + k * S, compressed_image(picture(k), stamp_ns=BEGIN + k * S, suffix=".tiff")) for k in range(2)]
    cut = {"/cam/image_raw": None, "/cam/image_raw/compressed": (COMPRESSED, broken)}
    assert len(lr.read_rig(recording(tmp_path / "tiff", **cut))) == 2


def _mosaic(pixels: np.ndarray) -> np.ndarray:
    found = pixels[..., 1].copy()
    found[::2, ::2] = pixels[::2, ::2, 0]
    found[1::2, 1::2] = pixels[1::2, 1::2, 2]
    return found


@pytest.mark.parametrize(
    ("encoding", "encoded", "most"),
    [
        ("rgb8", lambda p: p, 0),
        ("bgr8", lambda p: p[..., ::-1], 0),
        ("bgra8", lambda p: np.dstack([p[..., ::-1], p[..., :1]]), 0),
        ("mono8", lambda p: p[..., 1], 0),
        ("mono16", lambda p: p[..., 1].astype(np.uint16) << 8 | 255, 0),
        ("bayer_rggb8", _mosaic, 12),
        ("yuv422_yuy2", lambda p: cv2.cvtColor(p, cv2.COLOR_RGB2YUV_YUYV), 40),
    ],
)
def test_encodings_show_the_same_picture(tmp_path: Path, encoding: str, encoded: Any, most: int) -> None:
    gray = encoding.startswith("mono")
    made = [
        (BEGIN + k * S, image(encoded(picture(k)), stamp_ns=BEGIN + k * S, encoding=encoding, padding=6))
        for k in range(2)
    ]
    pixels = lr.read_rig(recording(tmp_path, **{"/cam/image_raw": (IMAGE, made)}))[0].photo.pixels
    wanted = np.repeat(picture(0)[..., 1:2], 3, axis=-1) if gray else picture(0)
    off = np.abs(pixels.astype(int) - wanted)[2:-2, 2:-2]
    assert np.quantile(off, 0.95) <= most


@pytest.mark.parametrize(
    ("model", "terms", "expected"),
    [
        ("rational_polynomial", (0.1, 0.2, 0.001, 0.002, 0.3, 0.4, 0.5, 0.6), Camera),
        ("", (), Camera),
        ("equidistant", (0.1, 0.02, 0.003, 0.0004), FisheyeCamera),
        ("fisheye", (0.1, 0.02, 0.003, 0.0004), FisheyeCamera),
    ],
)
def test_models_of_camera_info(tmp_path: Path, model: str, terms: tuple[float, ...], expected: type) -> None:
    made = info(CAMERA, model=model or "plumb_bob", d=np.array(terms))
    camera = lr.read_rig(recording(tmp_path, **{"/cam/camera_info": made}))[0].photo.camera
    assert camera == expected(*SIZE, 80.0, 81.0, 47.0, 32.0, terms)


def test_rectified_binned_and_cropped_pictures(tmp_path: Path) -> None:
    projection = np.array([70.0, 0, 45, 0, 0, 70, 30, 0, 0, 0, 1, 0])
    rect = {
        "/cam/image_raw": None,
        "/cam/image_rect": pictures({0: 0, 1000: 1}),
        "/cam/camera_info": info(p=projection),
    }
    assert lr.read_rig(recording(tmp_path / "a", **rect))[0].photo.camera == Camera(*SIZE, 70.0, 70.0, 45.0, 30.0)
    full = Camera(192, 128, 160.0, 162.0, 95.0, 64.0)
    binned = recording(tmp_path / "b", **{"/cam/camera_info": info(full, binning_x=2, binning_y=2)})
    assert lr.read_rig(binned)[0].photo.camera == full.resized(*SIZE)
    region = {"x_offset": 10, "y_offset": 20, "width": 96, "height": 64}
    cropped = lr.read_rig(recording(tmp_path / "c", **{"/cam/camera_info": info(full, roi=region)}))[0].photo.camera
    assert cropped == Camera(*SIZE, 160.0, 162.0, 85.0, 44.0)


def test_a_stated_camera_precedes_that_of_the_recording(tmp_path: Path) -> None:
    file = recording(tmp_path, **{"/cam/camera_info": None})
    with pytest.raises(CameraError, match=r"has no camera_info.*`camera`.*`focal_px`"):
        lr.read_rig(file)
    assert lr.read_rig(file, photo_options={"focal_px": 90.0})[0].photo.camera == Camera.from_focal(*SIZE, 90.0)
    own = Camera.from_focal(*SIZE, 77.0)
    assert lr.read_rig(file, photo_options={"camera": own})[0].photo.camera == own


@pytest.mark.parametrize(
    ("changed", "error", "words"),
    [
        ({"/cam/image_raw": None}, FormatError, r"no sensor_msgs/Image or CompressedImage, but .*CameraInfo"),
        ({"/points": None}, FormatError, r"no sensor_msgs/PointCloud2, but "),
        ({"/points": clouds({0: 0, 1000: 1}, frame="odom")}, FormatError, "frame odom, in which the scanner moves"),
        ({"/cam/camera_info": info(k=np.zeros(9))}, CameraError, "was not calibrated.*state the camera"),
        ({"/cam/camera_info": info(model="scaramuzza")}, CameraError, "camera model is 'scaramuzza'.*state the camera"),
        ({"/cam/camera_info": info(Camera.from_focal(640, 480, 500.0))}, CameraError, "96 x 64 pixels.*640 x 480"),
        ({"/cam/image_raw": pictures({0: 0, 1000: 1}, encoding="32FC1")}, FormatError, "encoded as 32FC1"),
        ({"/cam/image_raw": pictures({0: 0, 1000: 1}, encoding="rgba8")}, FormatError, "it is damaged"),
        ({"/cam/image_raw": (COMPRESSED, [(BEGIN, compressed_image(picture(0), stamp_ns=BEGIN))]),
          "/points": clouds({700: 0})}, FormatError, "was taken within half a period"),
    ],
)  # fmt: skip
def test_refusals_say_what_was_found(tmp_path: Path, changed: Topics, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        lr.read_rig(recording(tmp_path, **changed))


def test_topics_and_options_that_do_not_fit(tmp_path: Path) -> None:
    file = recording(tmp_path)
    with pytest.raises(OptionError, match="no topic /cam with pictures; there is /cam/image_raw"):
        lr.read_rig(file, images=["/cam"])
    with pytest.raises(OptionError, match="no topic /lidar with clouds; there is /points"):
        lr.read_rig(file, cloud="/lidar")
    for frames in (1, 41):
        with pytest.raises(OptionError, match="frames"):
            lr.read_rig(file, frames=frames)
    (tmp_path / "pairs.csv").write_text("scan,photo\n")
    with pytest.raises(OptionError, match=r"pairs\.csv is a table of pairs"):
        lr.read_rig(tmp_path / "pairs.csv", cloud="/points")
    with pytest.raises(FormatError, match="no such file"):
        lr.read_rig(tmp_path / "none.mcap")
    (tmp_path / "empty").mkdir()
    with pytest.raises(FormatError, match=r"metadata\.yaml"):
        lr.read_rig(tmp_path / "empty")


@pytest.mark.slow
def test_clouds_are_accumulated_on_request(tmp_path: Path) -> None:
    file = recording(tmp_path, **{"/points": clouds({0: 0, 100: 0, 200: 0, 1000: 1, 1100: 1})})
    one, several = lr.read_rig(file), lr.read_rig(file, scan_options={"seconds": 0.15})
    assert any("2 messages" in note for note in several[0].scan.notes)
    assert not any("messages" in note for note in one[0].scan.notes)


def test_a_described_recording_lists_its_pictures_and_their_cameras(tmp_path: Path) -> None:
    from ladarreg_core.formats import describe

    topics: Topics = {"/points": clouds({0: 1, 100: 2}), "/left/image": pictures({0: 1, 100: 2, 200: 3})}
    info = describe(write_recording(tmp_path / "run", "mcap", topics))
    assert info.images == ("/left/image: 3 pictures, without camera_info",)
    with_camera: Topics = {**topics, "/left/camera_info": (INFO, [(BEGIN, camera_info(CAMERA))])}
    info = describe(write_recording(tmp_path / "again", "mcap", with_camera))
    assert info.images == ("/left/image: 3 pictures, camera on /left/camera_info",)
    assert info.scans == ("/points: 2 clouds",)
