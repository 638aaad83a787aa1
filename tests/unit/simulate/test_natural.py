"""Textures of a natural spectrum: their slope, and that existing scenes stay as they are."""

from __future__ import annotations

import hashlib
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from ladarreg_core.simulate.worlds.materials import InkMixer
from ladarreg_core.simulate.worlds.natural import NaturalPrinter, natural_noise
from ladarreg_core.simulate.worlds.scenes import build_scene
from ladarreg_core.simulate.worlds.textures import Printer


def slope(image: NDArray[Any]) -> float:
    """Return the exponent with which the amplitudes of an image (H, W) fall, between 1/64 and 1/4 cycles per pixel."""
    height, width = image.shape
    power = np.abs(np.fft.rfft2(image - image.mean())) ** 2
    frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width))
    edges = np.geomspace(1 / 64, 1 / 4, 9)
    mean = [power[(frequency >= a) & (frequency < b)].mean() for a, b in pairwise(edges)]
    return float(np.polyfit(np.log(np.sqrt(edges[:-1] * edges[1:])), np.log(mean) / 2, 1)[0])


@pytest.mark.parametrize("shape", [(256, 256), (120, 400)])
def test_amplitudes_of_natural_noise_fall_with_frequency(shape: tuple[int, int]) -> None:
    noise = natural_noise(np.random.default_rng(0), *shape)
    assert abs(noise.mean()) < 1e-4
    assert noise.std() == pytest.approx(1, abs=1e-4)
    assert slope(noise) == pytest.approx(-1, abs=0.1)


def test_the_laser_sees_most_of_the_wear_that_the_eye_sees() -> None:
    rng = np.random.default_rng(1)
    worn = NaturalPrinter(rng, InkMixer(rng)).grain(np.full((200, 200, 4), 128, np.uint8), 0.06)
    seen = np.corrcoef(worn[..., 1].ravel(), worn[..., 3].ravel())[0, 1]
    assert 0.7 < seen < 0.9
    assert (worn[..., 0] == worn[..., 2]).all()


@pytest.mark.parametrize("kind", ["wall", "poster"])
def test_foliage_and_print_have_detail_at_every_scale(kind: str) -> None:
    for seed in range(3):
        rng = np.random.default_rng(seed)
        picture = getattr(NaturalPrinter(rng, InkMixer(rng)), kind)(2.0, 1.5).picture
        assert -2.0 < slope(picture[..., 1].astype(float)) < -0.2


@pytest.mark.long
def test_only_scenes_that_ask_for_it_are_natural() -> None:
    def texels(*, natural: bool) -> str:
        world = build_scene("boxes", layout=np.random.default_rng(5), natural=natural)
        return hashlib.sha256(world.texels.tobytes()).hexdigest()

    plain = build_scene("boxes", layout=np.random.default_rng(5))
    assert texels(natural=False) == hashlib.sha256(plain.texels.tobytes()).hexdigest()
    assert texels(natural=True) != texels(natural=False)
    assert isinstance(NaturalPrinter(np.random.default_rng(0), InkMixer(np.random.default_rng(0))), Printer)
