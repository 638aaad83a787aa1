"""Photographs: orientation, focal length and pixel formats."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from ladarreg_core.camera import Camera
from ladarreg_core.errors import CameraError, FormatError, OptionError, UnderspecifiedError
from ladarreg_core.formats import describe, read_photo
from ladarreg_core.formats.cameras.camera_file import write_camera
from ladarreg_core.formats.photos.exif import focal_from_exif, upright

WIDTH, HEIGHT = 60, 40


def picture(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)


def save(path: Path, values: np.ndarray, *, orientation: int | None = None, **tags: Any) -> Path:
    image = Image.fromarray(values)
    exif = image.getexif()
    if orientation is not None:
        exif[0x0112] = orientation
    names = {"focal": 0x920A, "film": 0xA405, "resolution": 0xA20E, "unit": 0xA210, "width": 0xA002}
    for name, value in tags.items():
        exif.get_ifd(0x8769)[names[name]] = value
    image.save(path, exif=exif)
    return path


@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientation_is_applied_as_opencv_applies_it(tmp_path: Path, orientation: int) -> None:
    path = save(tmp_path / "a.png", picture(), orientation=orientation)
    jpeg = save(
        tmp_path / "a.jpg", cv2.resize(picture(), (640, 480), interpolation=cv2.INTER_CUBIC), orientation=orientation
    )
    photo = read_photo(path, focal_px=50)
    expected = cv2.imread(str(jpeg))[..., ::-1]
    assert np.abs(read_photo(jpeg, focal_px=50).pixels.astype(int) - expected).mean() < 3
    np.testing.assert_array_equal(photo.pixels, upright(picture(), orientation))
    assert photo.camera.size == photo.pixels.shape[1::-1]


@pytest.mark.parametrize("orientation", [5, 6, 7, 8])
def test_the_cameras_size_says_whether_pixels_are_raw(tmp_path: Path, orientation: int) -> None:
    path = save(tmp_path / "a.png", picture(), orientation=orientation)
    raw, turned = Camera.from_focal(WIDTH, HEIGHT, 50), Camera.from_focal(HEIGHT, WIDTH, 50)
    np.testing.assert_array_equal(read_photo(path, camera=raw).pixels, picture())
    np.testing.assert_array_equal(read_photo(path, camera=turned).pixels, upright(picture(), orientation))
    assert "not applied" in read_photo(path, camera=raw).notes[0]
    with pytest.raises(CameraError, match=r"60 x 40.*40 x 60.*61 x 40"):
        read_photo(path, camera=Camera.from_focal(61, 40, 50))


def test_a_camera_of_another_size_is_refused(tmp_path: Path) -> None:
    path = save(tmp_path / "a.png", picture())
    write_camera(tmp_path / "c.json", Camera.from_focal(HEIGHT, WIDTH, 50))
    with pytest.raises(CameraError, match="60 x 40"):
        read_photo(path, camera=tmp_path / "c.json")


def test_where_the_focal_length_comes_from(tmp_path: Path) -> None:
    plain = save(tmp_path / "a.png", picture())
    assert read_photo(plain, focal_px=77).camera == Camera.from_focal(WIDTH, HEIGHT, 77)
    assert read_photo(plain, focal_mm=50, sensor_mm=30).camera.fx == pytest.approx(100)
    assert read_photo(plain, focal_px=77).camera.cx == (WIDTH - 1) / 2
    with pytest.raises(CameraError, match=r"`camera`.*`focal_px`.*`focal_mm`.*`sensor_mm`"):
        read_photo(plain)
    film = save(tmp_path / "b.jpg", picture(), film=50)
    assert read_photo(film).camera.fx == pytest.approx(50 / 36 * WIDTH)  # 3:2
    upright_film = save(tmp_path / "c.jpg", picture(), film=50, orientation=6)
    assert read_photo(upright_film).camera == Camera.from_focal(HEIGHT, WIDTH, read_photo(film).camera.fx)
    turned_mm = save(tmp_path / "d.jpg", picture(), orientation=6)
    assert read_photo(turned_mm, focal_mm=50, sensor_mm=30).camera.fx == pytest.approx(100)
    assert "35 mm" in describe(film).camera["source"]


@given(focal=st.floats(5, 200), crop=st.floats(1, 6), unit=st.sampled_from([2, 3, 4]), shrink=st.integers(1, 8))
def test_the_focal_plane_gives_the_focal_length_of_a_resized_image(
    focal: float, crop: float, unit: int, shrink: int
) -> None:
    width, height = 6000 // shrink, 4000 // shrink
    sensor_mm = 36 / crop
    per_unit = 6000 / sensor_mm * {2: 25.4, 3: 10.0, 4: 1.0}[unit]
    tags = {0x920A: focal, 0xA20E: per_unit, 0xA210: unit, 0xA002: 6000, 0xA405: focal * crop}
    found = focal_from_exif(tags, width, height)
    if 0.2 < focal / sensor_mm < 40:
        assert found is not None
        assert found.focal_px == pytest.approx(focal / sensor_mm * width, rel=1e-2)
    lying = focal_from_exif(tags | {0xA20E: per_unit * 3}, width, height)
    if lying is not None and 0.2 < focal / sensor_mm < 13:
        assert lying.focal_px == pytest.approx(
            focal / sensor_mm * math.hypot(width, height) / math.hypot(36, 24) * 36, rel=0.01
        )


@pytest.mark.parametrize("value", [0, -5, float("nan"), float("inf"), (0, 0), "wide", None, 1e-9, 1e12, b"x"])
def test_invalid_tags_give_no_focal_length(value: Any) -> None:
    assert focal_from_exif({0x920A: value, 0xA20E: 100.0, 0xA210: 2, 0xA405: value}, 600, 400) is None
    assert focal_from_exif({0x920A: 50.0, 0xA20E: value, 0xA210: value}, 600, 400) is None


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"focal_px": 0}, "positive"),
        ({"focal_px": float("nan")}, "positive"),
        ({"focal_mm": 50}, "without sensor_mm"),
        ({"sensor_mm": 36}, "without focal_mm"),
        ({"focal_px": 50, "focal_mm": 50, "sensor_mm": 36}, "one of them"),
        ({"focal_px": 50, "camera": Camera.from_focal(WIDTH, HEIGHT, 50)}, "one of them"),
    ],
)
def test_options_that_contradict_each_other_are_refused(tmp_path: Path, options: dict[str, Any], word: str) -> None:
    with pytest.raises(OptionError, match=word):
        read_photo(save(tmp_path / "a.png", picture()), **options)


@pytest.mark.parametrize("options", [{"focal_px": 2.9}, {"focal_px": 6001}, {"focal_mm": 1, "sensor_mm": 36}])
def test_an_implausible_focal_length_is_refused(tmp_path: Path, options: dict[str, Any]) -> None:
    with pytest.raises(CameraError, match=r"60 x 40 pixels, where most lenses have 30 to 600 px"):
        read_photo(save(tmp_path / "a.png", picture()), **options)


def test_gray_16_bit_and_transparent_images_become_rgb(tmp_path: Path) -> None:
    gray = picture()[..., 0]
    cases = {
        "gray.png": (Image.fromarray(gray), gray),
        "deep.png": (Image.fromarray(gray.astype(np.uint16) * 256), gray),
        "twelve.tif": (Image.fromarray(gray.astype(np.uint16) * 16 + 7), gray),
        "float.tif": (Image.fromarray(np.linspace(-1, 1, 2400, dtype=np.float32).reshape(40, 60)), None),
        "bits.png": (Image.fromarray(gray > 127), (gray > 127) * np.uint8(255)),
        "alpha.png": (Image.fromarray(np.dstack([picture(), gray])), picture()),
        "palette.png": (Image.fromarray(gray).convert("P"), gray),
    }
    for name, (image, expected) in cases.items():
        image.save(tmp_path / name)
        if name in ("deep.png", "twelve.tif"):  # may be temperatures
            with pytest.raises(UnderspecifiedError, match=r"`temperature_unit` C or K, or none"):
                read_photo(tmp_path / name, focal_px=50)
        photo = read_photo(tmp_path / name, focal_px=50, temperature_unit="none")
        assert photo.pixels.shape == (HEIGHT, WIDTH, 3), name
        if expected is None:
            np.testing.assert_allclose(photo.pixels[..., 0].ravel(), np.linspace(0, 255, 2400), atol=0.6)
        elif expected.ndim == 2:
            np.testing.assert_array_equal(photo.pixels, np.repeat(expected[..., None], 3, axis=-1), name)
        else:
            np.testing.assert_array_equal(photo.pixels, expected, name)


def test_a_truncated_image_is_an_error_at_any_length(tmp_path: Path) -> None:
    big = np.random.default_rng(1).integers(0, 256, (200, 300, 3), dtype=np.uint8)
    for suffix in (".jpg", ".png"):
        Image.fromarray(big).save(tmp_path / f"whole{suffix}")
        data = (tmp_path / f"whole{suffix}").read_bytes()
        for length in np.random.default_rng(0).integers(1, len(data) * 0.99, 25):
            (tmp_path / f"cut{suffix}").write_bytes(data[:length])
            with pytest.raises(FormatError):
                read_photo(tmp_path / f"cut{suffix}", focal_px=50)


def test_an_image_that_claims_a_huge_size_is_refused_at_once(tmp_path: Path) -> None:
    Image.fromarray(picture()).save(tmp_path / "a.png")
    data = bytearray((tmp_path / "a.png").read_bytes())
    import zlib

    for side in (12_000, 60_000):
        data[16:24] = side.to_bytes(4, "big") * 2
        data[29:33] = zlib.crc32(data[12:29]).to_bytes(4, "big")
        (tmp_path / "b.png").write_bytes(data)
        with pytest.raises(FormatError, match="claims"):
            read_photo(tmp_path / "b.png", focal_px=50)


def test_files_that_are_not_images_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_text("%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 10 10\n")
    with pytest.raises(FormatError, match="not an image"):
        read_photo(tmp_path / "a.jpg", focal_px=50)
    (tmp_path / "b.jpg").write_bytes(b"\0\0\0\x18ftypheic" + bytes(100))
    with pytest.raises(FormatError, match="HEIC"):
        read_photo(tmp_path / "b.jpg", focal_px=50)
