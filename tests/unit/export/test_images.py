import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from ladarreg_core.errors import ExportError, LadarregError, OptionError, ShapeError
from ladarreg_core.export.pictures.images import (
    uncertainty_picture,
    write_labels_png,
    write_registered_png,
    write_uncertainty_png,
)
from ladarreg_core.foundations.palette import UNKNOWN, VISIBILITY, scale_end
from ladarreg_core.surface.texture.registered_texture import Label, RegisteredTexture


def test_the_registered_picture_is_upright_and_lossless(tmp_path, texture):
    write_registered_png(tmp_path / "registered.png", texture)
    with Image.open(tmp_path / "registered.png") as image:
        assert image.mode == "RGB"
        np.testing.assert_array_equal(np.asarray(image), texture.image)


def test_the_labels_are_codes_that_a_person_can_read(tmp_path):
    labels = np.random.default_rng(0).choice(list(Label), size=(9, 14)).astype(np.uint8)
    texture = RegisteredTexture(np.zeros((9, 14, 3), np.uint8), labels)
    write_labels_png(tmp_path / "labels.png", texture)
    with Image.open(tmp_path / "labels.png") as image:
        assert image.mode == "P"
        np.testing.assert_array_equal(np.asarray(image), labels)
        colors = np.asarray(image.convert("RGB"))
    for label in Label:
        assert (colors[labels == label] == VISIBILITY[label]).all()
    # Readers that expand palettes show these colours.
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "labels.png"), cv2.IMREAD_COLOR)[..., ::-1], colors)


def test_the_png_shows_every_cell_and_a_scale(tmp_path):
    sigma = np.tile(np.linspace(0, 2, 300, dtype=np.float32), (90, 1))
    sigma[10:20, 50:80] = np.nan
    sigma[40, 40] = 1e6
    write_uncertainty_png(tmp_path / "u.png", sigma, most_px=2.0)
    read = cv2.imread(str(tmp_path / "u.png"))[..., ::-1]
    np.testing.assert_array_equal(read, uncertainty_picture(sigma, most_px=2.0))
    cells = read[:90, :300].astype(int)
    assert (cells[10:20, 50:80] == UNKNOWN).all()
    light = cells[0].sum(axis=-1)
    assert (np.diff(light) >= -2).all()
    assert light[-1] > 2.5 * light[0]
    np.testing.assert_array_equal(cells[40, 40], cells[0, -1])
    assert read.shape[0] > 90 + 40
    # The bar has exactly the colours of the cells, so that values can be read off.
    bar = {tuple(color) for row in read[90:] for color in row.tolist()}
    assert len({tuple(c) for c in cells[0].tolist()} - bar) < 60
    capped = uncertainty_picture(np.minimum(sigma, 2), most_px=2.0)
    assert not np.array_equal(capped[90:], read[90:]), "a scale that is exceeded says so"


@given(st.lists(st.one_of(st.floats(1e-5, 1e7), st.just(np.nan)), min_size=1, max_size=60))
@settings(max_examples=40, deadline=None)
def test_the_scale_ends_at_a_round_number_just_above_nearly_all(values):
    sigma = np.array([values], dtype=np.float32)
    end = scale_end(sigma)
    known = sigma[np.isfinite(sigma)]
    if known.size:
        high = np.percentile(known.astype(float), 98)
        assert high * 0.99999 <= end <= 1.51 * high
    assert uncertainty_picture(sigma).shape[0] > 1


def test_invalid_uncertainties_are_named_in_the_error(tmp_path):
    sigma = np.ones((4, 5))
    for bad in (0, -1, np.nan, np.inf, "2", True):
        with pytest.raises(OptionError, match="most_px"):
            uncertainty_picture(sigma, most_px=bad)
    for bad in (np.ones(5), np.ones((2, 2, 2)), np.ones((0, 5)), "picture"):
        with pytest.raises(ShapeError):
            uncertainty_picture(bad)
    with pytest.raises(ExportError):
        write_uncertainty_png(tmp_path / "no such folder" / "u.png", sigma)
    for empty in (sigma * np.nan, sigma * np.inf, sigma * 0, -sigma):
        assert uncertainty_picture(empty)[:4, :5].shape == (4, 5, 3)
    assert issubclass(OptionError, LadarregError)
