"""The thesis's corner detector."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view

from ladarreg_core.errors import OptionError, ShapeError
from ladarreg_core.matching.features.corners import CornerOptions, corner_maps, find_corners


def squares(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    image = np.full((120, 160), 60.0)
    for _ in range(8):
        v, u = rng.integers(15, 80), rng.integers(15, 110)
        image[v : v + 25, u : u + 30] = rng.uniform(80, 255)
    return image


def test_w_and_q_equal_the_formulas_of_the_thesis() -> None:
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


def test_corners_of_a_square_are_found_but_not_its_sides() -> None:
    image = np.full((80, 100), 50.0)
    image[20:60, 30:70] = 200
    found = find_corners(image, CornerOptions(count=None, q_min=0.5, non_maximum_px=3))
    expected = {(30, 20), (70, 20), (30, 60), (70, 60)}
    assert len(found) == 4
    for u, v in expected:
        assert np.hypot(found.uv[:, 0] - u + 0.5, found.uv[:, 1] - v + 0.5).min() < 2.2


def test_the_n_strongest_corners_are_returned_at_a_minimum_distance() -> None:
    rng = np.random.default_rng(1)
    image = rng.uniform(0, 255, (120, 150))
    best = find_corners(image, CornerOptions(count=50, q_min=0.1, non_maximum_px=4))
    more = find_corners(image, CornerOptions(count=None, q_min=0.1, non_maximum_px=4))
    assert len(best) == 50
    assert (np.diff(best.w) <= 0).all()
    np.testing.assert_array_equal(best.uv, more.uv[:50])
    distance = np.abs(more.uv[:, None] - more.uv).max(axis=-1) + 99 * np.eye(len(more))
    assert distance.min() > 4


def test_sub_pixel_corners_follow_a_sub_pixel_shift() -> None:
    v, u = np.mgrid[:60, :60].astype(float)

    def blob(cu: float, cv: float) -> np.ndarray:
        return 100 * np.exp(-((u - cu) ** 2 + (v - cv) ** 2) / (2 * 1.6**2))

    options = CornerOptions(count=1, q_min=0.3, sub_pixel=True, pre_blur_px=1.0)
    still, moved = (find_corners(blob(30 + d, 30 - d), options).uv[0] for d in (0.0, 0.4))
    np.testing.assert_allclose(moved - still, [0.4, -0.4], atol=0.1)


@pytest.mark.parametrize("image", [np.zeros((40, 40)), np.full((40, 40), 255.0), np.full((12, 9), 3.0)])
def test_a_uniform_image_has_no_corners(image: np.ndarray) -> None:
    assert len(find_corners(image)) == 0


def test_corners_exceed_the_thresholds() -> None:
    image = np.random.default_rng(2).uniform(0, 255, (90, 110))
    w, _ = corner_maps(image)
    w_min, q_min = float(np.quantile(w, 0.9)), 0.8
    found = find_corners(image, CornerOptions(count=None, w_min=w_min, q_min=q_min))
    u, v = found.uv.astype(int).T
    assert len(found) > 20
    np.testing.assert_array_equal(found.w, w[v, u])
    assert found.w.min() > w_min
    assert found.q.min() > q_min
    assert len(find_corners(image, CornerOptions(count=None, w_min=float(w.max())))) == 0


@pytest.mark.parametrize("maxima_of", ["every_pixel", "thresholded"])
def test_non_maximum_suppression_uses_all_or_thresholded_pixels(maxima_of: Any) -> None:
    image = squares(3) + np.random.default_rng(3).normal(0, 3, (120, 160))
    options = CornerOptions(count=None, q_min=0.5, non_maximum_px=2, border_px=8, maxima_of=maxima_of)
    w, q = corner_maps(image)
    left = np.where(q > 0.5, w, 0)
    rivals = w if maxima_of == "every_pixel" else left
    expected = np.zeros(w.shape, bool)
    for v in range(8, 112):
        for u in range(8, 152):
            expected[v, u] = left[v, u] > 0 and w[v, u] >= rivals[v - 2 : v + 3, u - 2 : u + 3].max()
    found = np.zeros_like(expected)
    u, v = find_corners(image, options).uv.astype(int).T
    found[v, u] = True
    np.testing.assert_array_equal(found, expected)


def test_the_thesis_order_only_adds_corners() -> None:
    image = squares(4) + np.random.default_rng(4).normal(0, 3, (120, 160))
    plain, literal = (
        {tuple(uv) for uv in find_corners(image, CornerOptions(count=None, maxima_of=m)).uv}
        for m in ("every_pixel", "thresholded")
    )
    assert plain < literal


def test_corners_lie_on_usable_pixels_only() -> None:
    image = np.random.default_rng(5).uniform(0, 255, (60, 80))
    usable = np.zeros(image.shape, bool)
    usable[20:40, 30:50] = True
    u, v = find_corners(image, CornerOptions(count=None), usable=usable).uv.astype(int).T
    assert len(u) > 5
    assert usable[v, u].all()


def test_corners_rotate_with_the_image() -> None:
    image = np.kron(np.random.default_rng(6).uniform(0, 255, (20, 30)), np.ones((4, 4)))
    image = cv2.GaussianBlur(image + np.random.default_rng(7).normal(0, 2, image.shape), (0, 0), 1.0)
    upright = find_corners(image, CornerOptions(count=None, border_px=3))
    turned = find_corners(np.rot90(image), CornerOptions(count=None, border_px=3))
    back = np.column_stack([image.shape[1] - 1 - turned.uv[:, 1], turned.uv[:, 0]])
    ours, theirs = ({tuple(uv) for uv in pixels} for pixels in (upright.uv, back))
    assert len(ours & theirs) > 0.98 * len(ours | theirs)


BAD_OPTIONS: list[dict[str, Any]] = [
    {"q_min": 1.5}, {"q_min": -0.1}, {"q_min": np.nan}, {"w_min": -1}, {"w_min": np.inf}, {"w_min": "a"},
    {"count": 0}, {"count": 2.5}, {"count": True}, {"non_maximum_px": 0}, {"non_maximum_px": None},
    {"border_px": -1}, {"pre_blur_px": -1}, {"pre_blur_px": np.nan}, {"maxima_of": "all"},
]  # fmt: skip


@pytest.mark.parametrize("options", BAD_OPTIONS, ids=str)
def test_invalid_options_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(OptionError, match=next(iter(options))) as caught:
        CornerOptions(**options)
    assert "\n" not in str(caught.value)


def test_invalid_images_are_refused() -> None:
    holed = squares()
    holed[5, 5] = np.nan
    for image in (np.zeros((4, 5, 3)), np.zeros((0, 7)), np.zeros(9), holed):
        with pytest.raises(ShapeError):
            find_corners(image)
    with pytest.raises(ShapeError, match="usable"):
        find_corners(squares(), usable=np.ones((3, 3), bool))
