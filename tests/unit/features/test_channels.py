"""Orientation channels: invariances and responses."""

from __future__ import annotations

import numpy as np

from ladarreg_core.features.channels import add_channels, normalised_channels, raw_channels


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


def test_an_edge_responds_in_the_channel_across_it() -> None:
    v, u = np.mgrid[:64, :64].astype(np.float32)
    for k in range(8):
        angle = k * np.pi / 8
        edge = 100 * np.tanh(((u - 32) * np.cos(angle) + (v - 32) * np.sin(angle)) / 2).astype(np.float32)
        assert raw_channels([edge])[:, 32, 32].argmax() == k


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
