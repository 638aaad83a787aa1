"""Thermal pictures: what is one, what is none, and what becomes of it."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import ArrayLike

import ladarreg_core as lr
from ladarreg_core.errors import ShapeError
from ladarreg_core.foundations.temperatures import centikelvin, kelvin_of, thermal_gray
from ladarreg_core.matching.images.photo_levels import photo_levels
from ladarreg_core.photo import thermal_photo

CAMERA = lr.Camera.from_focal(40, 30, 50.0)


def scene(seed: int = 0, low_k: float = 285.0, high_k: float = 310.0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(low_k, high_k, (30, 40)).astype(np.float32)


@given(st.floats(221, 619), st.floats(0, 30))
def test_centikelvin_there_and_back(low_k: float, span_k: float) -> None:
    kelvin = scene(low_k=low_k, high_k=min(low_k + span_k, 619.5))
    again = kelvin_of(centikelvin(kelvin))
    assert again is not None
    assert np.abs(again - kelvin).max() <= 0.005 + 1e-4


@pytest.mark.parametrize(
    "values",
    [
        scene().astype(np.uint8),
        np.repeat(centikelvin(scene())[..., None], 3, axis=-1),
        np.linspace(0, 65535, 1200).reshape(30, 40).astype(np.uint16),
        (centikelvin(scene()) // 16).astype(np.uint16),
        (scene() - 273.15).astype(np.float32),
        np.zeros((0, 4), np.uint16),
        centikelvin(scene()).astype(np.int32),
    ],
    ids=["8 bits", "colour", "a photograph of 16 bits", "12 bits", "degrees C", "empty", "signed"],
)
def test_what_is_no_thermal_picture(values: np.ndarray) -> None:
    assert kelvin_of(values) is None


@given(st.floats(-50, 50))
def test_gray_levels_follow_the_temperature_around_its_median(offset_k: float) -> None:
    kelvin = np.sort(scene().ravel()).reshape(30, 40)
    gray = thermal_gray(kelvin)
    assert (np.diff(gray.ravel()) >= 0).all()
    assert abs(float(np.median(gray))) < 1
    assert np.abs(thermal_gray(kelvin + np.float32(offset_k)) - gray).max() < 0.1  # a drifting camera sees the same
    steps = np.array([[290.0, 290.0, 290.5]], np.float32)
    assert thermal_gray(steps)[0, 2] == pytest.approx(60 * np.arcsinh(1.0), abs=0.01)


@pytest.mark.parametrize(
    "kelvin",
    [scene()[..., None], scene()[:0], np.full((30, 40), np.nan), scene() - 400, scene()[:, 1:]],
    ids=["three axes", "empty", "NaN", "below absolute zero", "another size"],
)
def test_what_is_no_temperature_is_refused(kelvin: ArrayLike) -> None:
    with pytest.raises(ShapeError):
        thermal_photo(kelvin, CAMERA)


@pytest.mark.parametrize("suffix", ["png", "tiff"])
def test_thermal_files_are_told_by_their_values(tmp_path: Path, suffix: str) -> None:
    kelvin = scene()
    values = centikelvin(kelvin) if suffix == "png" else kelvin
    path = tmp_path / f"thermal.{suffix}"
    assert cv2.imwrite(str(path), values)
    photo = lr.read_photo(path, camera=CAMERA)
    assert photo.temperature_k is not None
    assert np.abs(photo.temperature_k - kelvin).max() < 0.006
    assert photo.pixels.shape == (30, 40, 3)
    assert any("thermal" in note and "11.9 to 36.8 C" in note for note in photo.notes), photo.notes
    levels = photo_levels(photo, CAMERA)
    assert [len(planes) for planes in levels.planes] == [1, 1, 1]
    assert np.abs(levels.gray - thermal_gray(photo.temperature_k)).max() < 1e-3


def test_a_16_bit_photograph_stays_a_photograph(tmp_path: Path) -> None:
    path = tmp_path / "gray.png"
    assert cv2.imwrite(str(path), np.linspace(0, 65535, 1200).reshape(30, 40).astype(np.uint16))
    photo = lr.read_photo(path, camera=CAMERA, temperature_unit="none")
    assert photo.temperature_k is None
    assert int(photo.pixels.max()) == 255


def test_pixels_without_a_measurement_have_the_median() -> None:
    kelvin = kelvin_of(np.where(np.eye(30, 40) > 0, np.nan, scene()))
    assert kelvin is not None
    assert np.isfinite(kelvin).all()
    assert np.count_nonzero(kelvin != scene().astype(np.float32)) <= 30


def test_a_hazy_photograph_of_sixteen_bits_is_not_taken_for_heat() -> None:
    hazy = np.random.default_rng(0).integers(23_000, 61_000, (60, 80)).astype(np.uint16)
    assert kelvin_of(hazy) is None
    room = np.random.default_rng(0).normal(29_500, 300, (60, 80)).astype(np.uint16)
    room[20:24, 20:24] = 45_000  # a hot pipe
    assert kelvin_of(room) is not None
