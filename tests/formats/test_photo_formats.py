"""Pictures that other programs write: deep and floating-point TIFF, AVIF, CMYK, thermal images and their units."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from PIL import Image

from ladarreg_core.errors import CameraError, FormatError, LadarregError, UnderspecifiedError
from ladarreg_core.formats import describe, read_photo, recognise
from ladarreg_core.foundations import opened_image
from tests.formats.test_photo_files import save

RAMP = np.linspace(0, 1, 48 * 64).reshape(48, 64)
COLORS = np.stack([RAMP, RAMP[::-1], RAMP[:, ::-1]], axis=-1)
DEEP = np.rint(COLORS * 65535).astype(np.uint16)
WARM = (18 + 18 * RAMP).astype(np.float32)  # a room and the people in it, deg C


def seed_files(folder: Path) -> list[Path]:
    """Write pictures for the tests of damaged files."""
    tifffile.imwrite(folder / "deep.tif", DEEP, photometric="rgb", compression="deflate", predictor=2)
    tifffile.imwrite(folder / "tiles.tif", DEEP, photometric="rgb", tile=(16, 16), bigtiff=True)
    tifffile.imwrite(folder / "planes.tif", np.moveaxis(DEEP, -1, 0), photometric="rgb", planarconfig="separate")
    tifffile.imwrite(folder / "kelvin.tif", WARM + np.float32(273.15))
    tifffile.imwrite(folder / "celsius.tif", WARM, description='{"unit": "Celsius"}')
    Image.fromarray((COLORS * 255).astype(np.uint8)).save(folder / "photo.avif", quality=90)
    return sorted(folder.iterdir())


@pytest.mark.parametrize(
    "how",
    [
        {}, {"bigtiff": True}, {"tile": (16, 32)}, {"compression": "deflate"}, {"byteorder": ">"},
        {"compression": "deflate", "predictor": 2}, {"planarconfig": "separate"}, {"rowsperstrip": 7},
    ],
)  # fmt: skip
def test_colors_of_16_bits_are_read_whatever_their_layout(tmp_path: Path, how: dict[str, Any]) -> None:
    values = np.moveaxis(DEEP, -1, 0) if "planarconfig" in how else DEEP
    tifffile.imwrite(tmp_path / "a.tif", values, photometric="rgb", **how)
    photo = read_photo(tmp_path / "a.tif", focal_px=60)
    np.testing.assert_array_equal(photo.pixels, DEEP >> 8)
    assert not np.array_equal(photo.pixels, (DEEP >> 8)[:, ::-1])
    assert describe(tmp_path / "a.tif").size == "64 x 48 pixels"


def test_other_kinds_of_tiff(tmp_path: Path) -> None:
    palette = np.zeros((3, 256), np.uint16)
    palette[0] = np.arange(256) * 257
    levels = (RAMP * 255).astype(np.uint8)
    tifffile.imwrite(tmp_path / "palette.tif", levels, photometric="palette", colormap=palette)
    assert (read_photo(tmp_path / "palette.tif", focal_px=60).pixels[..., 0] == levels).all()
    ink = np.zeros((48, 64, 4), np.uint16)
    ink[..., 1] = 65535  # magenta
    tifffile.imwrite(tmp_path / "cmyk.tif", ink, photometric="separated")
    assert (read_photo(tmp_path / "cmyk.tif", focal_px=60).pixels == [255, 0, 255]).all()
    tifffile.imwrite(tmp_path / "alpha.tif", np.dstack([DEEP, DEEP[..., 0]]), photometric="rgb", extrasamples=[2])
    assert (read_photo(tmp_path / "alpha.tif", focal_px=60).pixels == DEEP >> 8).all()
    tifffile.imwrite(tmp_path / "pages.tif", np.stack([DEEP, DEEP[::-1]]), photometric="rgb")
    photo = read_photo(tmp_path / "pages.tif", focal_px=60)
    assert (photo.pixels == DEEP >> 8).all()
    assert "several pages" in photo.notes[0]
    tifffile.imwrite(tmp_path / "white.tif", 65535 - DEEP[..., 0], photometric="miniswhite")
    assert (
        read_photo(tmp_path / "white.tif", focal_px=60, temperature_unit="none").pixels[..., 0] == DEEP[..., 0] >> 8
    ).all()


def test_what_no_decoder_reads_is_refused_with_a_way_out(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.tif", DEEP, photometric="rgb", compression="lzma")
    data = bytearray((tmp_path / "a.tif").read_bytes())
    at = data.index(struct.pack("<HHII", 259, 3, 1, 34925))
    data[at : at + 12] = struct.pack("<HHII", 259, 3, 1, 50002)  # JPEG XL
    (tmp_path / "a.tif").write_bytes(data)
    with pytest.raises(FormatError, match=r"compression.*JPEGXL.*Deflate"):
        read_photo(tmp_path / "a.tif", focal_px=60)
    (tmp_path / "a.heic").write_bytes(struct.pack(">I", 24) + b"ftypheic" + bytes(4) + b"mif1heic" + bytes(200))
    assert recognise(tmp_path / "a.heic").kind == "photo"
    with pytest.raises(FormatError, match=r"HEIC.*(pillow-heif.*JPEG|cannot|not an image|damaged)"):
        read_photo(tmp_path / "a.heic", focal_px=60)


@pytest.mark.parametrize("first", [b"II*\0", b"II*\0\x08\0\0\0", b"MM\0*\0\0\0\x08"])
def test_a_tiff_that_ends_before_its_image_is_said_to_be_truncated(tmp_path: Path, first: bytes) -> None:
    path = tmp_path / "raw.cr2"
    path.write_bytes(first)
    with pytest.raises(FormatError, match="truncated"):
        describe(path)


def test_a_strip_that_holds_more_than_it_may_is_refused(tmp_path: Path) -> None:
    import zlib

    tifffile.imwrite(tmp_path / "a.tif", DEEP, photometric="rgb", compression="deflate", rowsperstrip=48)
    with tifffile.TiffFile(tmp_path / "a.tif") as tif:
        offset, count = tif.pages[0].dataoffsets[0], tif.pages[0].databytecounts[0]
    bomb = zlib.compress(bytes(50_000_000), 9)
    data = bytearray((tmp_path / "a.tif").read_bytes())
    at = data.index(struct.pack("<I", count), 8)
    data[at : at + 4] = struct.pack("<I", len(bomb))
    place = data.index(struct.pack("<I", offset), 8)
    data[place : place + 4] = struct.pack("<I", len(data))
    (tmp_path / "a.tif").write_bytes(bytes(data) + bomb)
    with pytest.raises(FormatError, match="more than the 18,432 bytes"):
        read_photo(tmp_path / "a.tif", focal_px=60)


def test_avif_and_cmyk_jpeg(tmp_path: Path) -> None:
    smooth = (COLORS * 255).astype(np.uint8)
    Image.fromarray(smooth).save(tmp_path / "a.avif", quality=95)
    assert recognise(tmp_path / "a.avif").kind == "photo"
    assert np.abs(read_photo(tmp_path / "a.avif", focal_px=60).pixels.astype(int) - smooth).mean() < 4
    assert describe(tmp_path / "a.avif").format == "AVIF"
    Image.fromarray(smooth).convert("CMYK").save(tmp_path / "a.jpg", quality=95)
    assert np.abs(read_photo(tmp_path / "a.jpg", focal_px=60).pixels.astype(int) - smooth).mean() < 8


def test_the_unit_of_temperatures_is_read_given_or_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "warm.tif"
    tifffile.imwrite(path, WARM)
    with pytest.raises(UnderspecifiedError, match=r"18.0 to 36.0.*`temperature_unit` C or K, or none"):
        read_photo(path, focal_px=60)
    given = read_photo(path, focal_px=60, temperature_unit="C")
    assert given.temperature_k is not None
    np.testing.assert_allclose(given.temperature_k, WARM + 273.15, atol=1e-4)
    assert read_photo(path, focal_px=60, temperature_unit="none").temperature_k is None
    with pytest.raises(LadarregError, match="cannot be temperatures in K"):
        read_photo(path, focal_px=60, temperature_unit="K")
    for description in ('{"unit": "Celsius"}', "Temperature [°C]", '<Item name="u" role="unittype">C</Item>'):
        tifffile.imwrite(path, WARM, description=description.encode() if "°" in description else description)
        stated = read_photo(path, focal_px=60)
        assert stated.temperature_k is not None, description
        np.testing.assert_allclose(stated.temperature_k, WARM + 273.15, atol=1e-4)
    tifffile.imwrite(path, np.rint((WARM + 273.15) * 10).astype(np.uint16))  # decikelvin
    with pytest.raises(UnderspecifiedError, match=r"2912.* to 309"):
        read_photo(path, focal_px=60)
    tenths = read_photo(path, focal_px=60, temperature_unit="K")
    assert tenths.temperature_k is not None
    np.testing.assert_allclose(tenths.temperature_k, WARM + 273.15, atol=0.06)
    gaps = WARM.copy()
    gaps[:2, :3] = np.nan
    tifffile.imwrite(path, gaps)
    with pytest.raises(UnderspecifiedError, match=r"18.0 to 36.0"):
        read_photo(path, focal_px=60)
    holes = read_photo(path, focal_px=60, temperature_unit="C").temperature_k
    assert holes is not None
    np.testing.assert_allclose(holes[2:], WARM[2:] + 273.15, atol=1e-4)
    tifffile.imwrite(path, RAMP.astype(np.float32))  # a picture from 0 to 1 is none
    assert read_photo(path, focal_px=60).temperature_k is None


def test_a_radiometric_jpeg_is_not_taken_for_a_photograph(tmp_path: Path) -> None:
    Image.fromarray((COLORS * 255).astype(np.uint8)).save(tmp_path / "a.jpg")
    data = (tmp_path / "a.jpg").read_bytes()
    marked = data[:2] + b"\xff\xe1" + struct.pack(">H", 2 + 40) + b"FLIR\0\1\0\0".ljust(40, b"\0") + data[2:]
    (tmp_path / "a.jpg").write_bytes(marked)
    with pytest.raises(FormatError, match=r"FLIR|could not be read"):
        read_photo(tmp_path / "a.jpg", focal_px=60)
    assert read_photo(tmp_path / "a.jpg", focal_px=60, temperature_unit="none").temperature_k is None


def test_focal_lengths_of_cameras_with_lenses(tmp_path: Path) -> None:
    pixels = (COLORS * 255).astype(np.uint8)
    path = save(tmp_path / "a.jpg", pixels, focal=24.0)
    with pytest.raises(CameraError, match=r"24 mm .*`sensor_mm`"):
        read_photo(path)
    assert read_photo(path, sensor_mm=36).camera.fx == pytest.approx(24 / 36 * 64)
    upright = save(tmp_path / "b.jpg", np.swapaxes(pixels, 0, 1), focal=24.0)  # turned by a program
    photo = read_photo(upright, sensor_mm=36)
    assert photo.camera.fx == pytest.approx(24 / 36 * 64)
    assert "longer side" in photo.notes[-1]
    # 36 mm hold 6000 pixels in the original: 1666.67 a cm
    resized = save(tmp_path / "c.jpg", pixels, focal=24.0, resolution=6000 / 3.6, unit=3, width=6000)
    assert read_photo(resized).camera.fx == pytest.approx(24 / 36 * 64, rel=1e-3)
    mad = save(tmp_path / "d.jpg", pixels, focal=24.0, resolution=1083.7, unit=2)  # a sensor of 1.5 mm
    with pytest.raises(CameraError, match="`sensor_mm`"):
        read_photo(mad)
    image = Image.fromarray(pixels)
    exif = image.getexif()
    exif.get_ifd(0x8769).update({0x920A: 24.0, 0xA002: 6000, 0xA003: 4000})
    image.save(tmp_path / "e.jpg", exif=exif)  # 4:3 of 3:2
    assert "cropped" in read_photo(tmp_path / "e.jpg", sensor_mm=36).notes[-1]


def test_pillows_limit_is_ours_only_while_a_file_is_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.png"
    Image.new("RGB", (40, 30)).save(path)
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 100)  # of whoever else uses Pillow: twice as many are refused
    with pytest.raises(Image.DecompressionBombError):
        Image.open(path)
    assert read_photo(path, focal_px=50.0).camera.size == (40, 30)
    assert Image.MAX_IMAGE_PIXELS == 100
    monkeypatch.setattr(opened_image, "MAX_PIXELS", 1000)
    with pytest.raises(FormatError, match="pixels"):
        read_photo(path, focal_px=50.0)
