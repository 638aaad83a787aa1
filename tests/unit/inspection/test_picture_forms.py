"""The forms in which pictures are sent."""

from __future__ import annotations

import io

import cv2
import numpy as np
import pytest
from PIL import Image

from ladarreg_core.errors import OptionError
from ladarreg_core.formats import read_scan
from ladarreg_core.inspection.picture_forms import (
    PART_PX,
    QUICK_PX,
    EncodedPicture,
    exact,
    level_column_row,
    part,
    quick,
    reduced,
)
from ladarreg_core.inspection.pictures import Stretch, inspection_views, scan_picture
from ladarreg_core.simulate.sample import sample_folder


def decoded(picture: EncodedPicture) -> np.ndarray:
    image = Image.open(io.BytesIO(picture.data))
    assert Image.MIME[image.format or ""] == picture.media_type
    return np.asarray(image)


@pytest.fixture(scope="module")
def pixels() -> np.ndarray:
    view = inspection_views(read_scan(sample_folder() / "scan.npz"))[0].view
    return scan_picture(view, "intensity", Stretch())


def test_an_exact_picture_is_exact(pixels: np.ndarray) -> None:
    assert np.array_equal(decoded(exact(pixels)), pixels)


def test_a_quick_picture_is_small_and_hardly_different(pixels: np.ndarray) -> None:
    picture = quick(pixels)
    found = decoded(picture).astype(float)
    assert max(found.shape[:2]) == QUICK_PX
    expected = cv2.resize(pixels, found.shape[1::-1], interpolation=cv2.INTER_AREA).astype(float)
    assert np.sqrt(np.mean((found - expected) ** 2)) < 4.1
    assert len(picture.data) < len(exact(pixels).data) / 10


def test_a_small_picture_keeps_its_size_and_its_transparency() -> None:
    rgba = np.zeros((50, 60, 4), np.uint8)
    rgba[10:40, 10:40] = (200, 150, 100, 255)
    found = decoded(quick(rgba))
    assert found.shape == rgba.shape
    assert np.array_equal(found[..., 3], rgba[..., 3])


@pytest.mark.parametrize("level", [0, 1, 2])
def test_the_parts_of_a_level_make_up_the_level(pixels: np.ndarray, level: int) -> None:
    whole = reduced(pixels, level)
    rows, columns = (-(-side // PART_PX) for side in whole.shape[:2])
    bands = [np.hstack([decoded(part(whole, column, row)) for column in range(columns)]) for row in range(rows)]
    assert np.array_equal(np.vstack(bands), whole)
    for outside in ((columns, 0), (0, rows)):
        with pytest.raises(OptionError, match="outside"):
            part(whole, *outside)


def test_sides_of_a_level_are_rounded_up() -> None:
    odd = np.zeros((5, 9, 3), np.uint8)
    assert reduced(odd, 1).shape == (3, 5, 3)
    assert reduced(odd, 4).shape == (1, 1, 3)


@pytest.mark.parametrize("text", ["", "1.2", "1.2.3.4", "-1.0.0", "a.b.c", "1.2.1234567", "13.0.0"])
def test_a_part_that_is_not_three_numbers_is_refused(text: str) -> None:
    with pytest.raises(OptionError):
        level_column_row(text)
