"""Images of one channel whose pixels are values."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image

from ladarreg_core.errors import FormatError
from ladarreg_core.formats.photos.values_file import read_values

VALUES = np.arange(12, dtype=np.float32).reshape(3, 4) * 100


def test_numbers_are_as_in_the_file(tmp_path: Path) -> None:
    real = np.where(VALUES == 300, np.nan, VALUES - 250.5)
    tifffile.imwrite(tmp_path / "real.tif", real.astype(np.float32))
    np.testing.assert_array_equal(read_values(tmp_path / "real.tif"), real)
    for name, kind in (("sixteen.png", np.uint16), ("sixteen.tif", np.uint16), ("eight.png", np.uint8)):
        numbers = (VALUES / (1 if kind is np.uint16 else 100)).astype(kind)
        cv2.imwrite(str(tmp_path / name), numbers)
        found = read_values(tmp_path / name)
        assert found.dtype == np.float32
        np.testing.assert_array_equal(found, numbers)
    cv2.imwrite(str(tmp_path / "three.png"), np.repeat(numbers[..., None], 3, axis=-1))
    np.testing.assert_array_equal(read_values(tmp_path / "three.png"), numbers)


def test_they_are_upright(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(VALUES.astype(np.uint8) // 10).save(tmp_path / "turned.png", exif=exif)
    assert read_values(tmp_path / "turned.png").shape == (4, 3)


def test_what_is_no_image_of_values_is_refused(tmp_path: Path) -> None:
    colors = np.random.default_rng(0).integers(0, 255, (5, 5, 3)).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "colors.png"), colors)
    with pytest.raises(FormatError, match=r"colors.png.*it has colours"):
        read_values(tmp_path / "colors.png")
    whole = (tmp_path / "colors.png").read_bytes()
    (tmp_path / "half.png").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "text.png").write_text("no image")
    for name in ("half.png", "text.png"):
        with pytest.raises(FormatError):
            read_values(tmp_path / name)
