"""Orientation channels: invariances and responses."""

from __future__ import annotations

import numpy as np
import pytest

from ladarreg_core.matching.features.channels import add_channels, normalised_channels, raw_channels


def scene(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    image = np.full((96, 128), 90.0, np.float32)
    for _ in range(25):
        v, u, h, w = rng.integers(0, 80), rng.integers(0, 110), rng.integers(6, 30), rng.integers(6, 40)
        image[v : v + h, u : u + w] = rng.uniform(20, 230)
    return image


def test_channels_do_not_depend_on_the_sign_of_contrast() -> None:
    image = scene()
    np.testing.assert_allclose(raw_channels([image]), raw_channels([255 - image]), atol=1e-3)


def test_normalised_channels_are_invariant_to_brightness_and_gain() -> None:
    image = scene()
    first, second = (normalised_channels(raw_channels([picture])) for picture in (image, 0.3 * image + 40))
    np.testing.assert_allclose(first, second, atol=1e-4)


@pytest.mark.parametrize(("harmonics", "tolerance"), [(2, 0.07), (3, 0.02)])
def test_scalar_products_are_those_of_rectified_responses(harmonics: int, tolerance: float) -> None:
    # What the channels stand for: max(|g| (|cos (t - a)| - .83), 0) in all directions t, to its first harmonics.
    t = np.linspace(0, np.pi, 720, endpoint=False)
    v, u = np.mgrid[:32, :32].astype(np.float32)
    angles = np.deg2rad([0, 7, 20, 31, 45, 60, 90, 133, 170])
    ramps = [20 * (u * np.cos(a) + v * np.sin(a)).astype(np.float32) for a in angles]
    found = [raw_channels([ramp], harmonics=harmonics)[:, 16, 16] for ramp in ramps]
    responses = [np.maximum(np.abs(np.cos(t - a)) - 0.83, 0) for a in angles]
    products, asked = (np.array(vectors) @ np.array(vectors).T for vectors in (found, responses))
    np.testing.assert_allclose(products / products[0, 0], asked / asked[0, 0], atol=tolerance)


def test_channels_turn_with_the_edge() -> None:
    v, u = np.mgrid[:64, :64].astype(np.float32)
    edges = [
        100 * np.tanh(((u - 32) * np.cos(a) + (v - 32) * np.sin(a)) / 2).astype(np.float32) for a in (0.0, 0.4, 1.1)
    ]
    first, *others = (raw_channels([edge], harmonics=3)[:, 32, 32] for edge in edges)
    for angle, channels in zip((0.4, 1.1), others, strict=True):
        for harmonic in (1, 2, 3):
            cosine, sine = channels[2 * harmonic - 1], channels[2 * harmonic]
            assert np.arctan2(sine, cosine) == pytest.approx(np.angle(np.exp(2j * harmonic * angle)), abs=0.05)
        assert np.linalg.norm(channels) == pytest.approx(np.linalg.norm(first), rel=0.05)


def test_channels_of_planes_are_summed() -> None:
    image = scene()
    # Opposite gradients cancel in a gray sum; the channels of the two images must add up.
    np.testing.assert_allclose(raw_channels([image, 255 - image]), 2 * raw_channels([image]), rtol=1e-4, atol=1e-2)


def test_norms_are_below_one_and_a_uniform_image_has_no_response() -> None:
    channels = normalised_channels(raw_channels([scene()]))
    assert np.linalg.norm(channels, axis=-1).max() < 1
    both = add_channels(channels, channels)
    assert np.linalg.norm(both, axis=-1).max() <= 1 + 1e-5
    assert not normalised_channels(raw_channels([np.full((40, 50), 7.0, np.float32)])).any()
