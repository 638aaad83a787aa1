"""The thesis's corner detector."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view

from ladarreg_core.errors import OptionError, ShapeError
from ladarreg_core.features.corners import CornerOptions, corner_maps, find_corners


def squares(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    image = np.full((120, 160), 60.0)
    for _ in range(8):
        v, u = rng.integers(15, 80), rng.integers(15, 110)
        image[v : v + 25, u : u + 30] = rng.uniform(80, 255)
    return image


def test_w_and_q_are_the_thesis_formulas() -> None:
    image = squares()
    w, q = corner_maps(image)
    kernel = np.array([[-1, 0, 1], [-2, 0, 2], [-1, 0, 1.0]])
    padded = np.pad(image, 1, mode="reflect")
    neighbourhoods = sliding_window_view(padded, (3, 3))
    fh, fv = (neighbourhoods * kernel).sum((-1, -2)), (neighbourhoods * kernel.T).sum((-1, -2))
    sums = [sliding_window_view(p, (5, 5)).sum((-1, -2)) for p in (fv * fv, fv * fh, fh * fh)]
    det, trace = sums[0] * sums[2] - sums[1] ** 2, sums[0] + sums[2]
    strong = trace > 1e3
    middle = (slice(2, -2), slice(2, -2))
    expected = 2 * det / np.maximum(trace, 1)
    np.testing.assert_allclose(w[middle][strong], expected[strong], rtol=1e-3, atol=trace.max() * 1e-6)
    np.testing.assert_allclose(q[middle][strong], (4 * det / np.maximum(trace, 1) ** 2)[strong], atol=2e-3)


def test_the_corners_of_a_square_are_found_and_its_sides_are_not() -> None:
    image = np.full((80, 100), 50.0)
    image[20:60, 30:70] = 200
    found = find_corners(image, CornerOptions(count=None, q_min=0.5, non_maximum_px=3))
    expected = {(30, 20), (70, 20), (30, 60), (70, 60)}
    assert len(found) == 4
    for u, v in expected:
        assert np.hypot(found.uv[:, 0] - u + 0.5, found.uv[:, 1] - v + 0.5).min() < 2.2


def test_the_best_n_are_the_strongest_and_keep_their_distance() -> None:
    rng = np.random.default_rng(1)
    image = rng.uniform(0, 255, (120, 150))
    best = find_corners(image, CornerOptions(count=50, q_min=0.1, non_maximum_px=4))
    more = find_corners(image, CornerOptions(count=None, q_min=0.1, non_maximum_px=4))
    assert len(best) == 50
    assert (np.diff(best.w) <= 0).all()
    np.testing.assert_array_equal(best.uv, more.uv[:50])
    apart = np.abs(more.uv[:, None] - more.uv).max(axis=-1) + 99 * np.eye(len(more))
    assert apart.min() > 4


def test_sub_pixel_corners_follow_a_sub_pixel_shift() -> None:
    v, u = np.mgrid[:60, :60].astype(float)

    def blob(cu: float, cv: float) -> np.ndarray:
        return 100 * np.exp(-((u - cu) ** 2 + (v - cv) ** 2) / (2 * 1.6**2))

    options = CornerOptions(count=1, q_min=0.3, sub_pixel=True, pre_blur_px=1.0)
    still, moved = (find_corners(blob(30 + d, 30 - d), options).uv[0] for d in (0.0, 0.4))
    np.testing.assert_allclose(moved - still, [0.4, -0.4], atol=0.1)


@pytest.mark.parametrize("image", [np.zeros((40, 40)), np.full((40, 40), 255.0), np.full((12, 9), 3.0)])
def test_a_flat_picture_has_no_corners(image: np.ndarray) -> None:
    assert len(find_corners(image)) == 0


def test_nonsense_is_refused() -> None:
    with pytest.raises(OptionError):
        find_corners(squares(), CornerOptions(q_min=1.5))
    with pytest.raises(ShapeError):
        find_corners(np.zeros((4, 5, 3)))
