"""Correlation of corners and selection of unique matches."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ladarreg_core.errors import OptionError, ShapeError
from ladarreg_core.matching.features.correlation import (
    correlation_product,
    correlation_rows,
    edge_image,
    unique_matches,
    windows_at,
)
from ladarreg_core.matching.features.descriptors import unit_rows


def test_the_product_is_the_mean_of_two_correlation_coefficients() -> None:
    rng = np.random.default_rng(0)
    first, second = rng.uniform(0, 255, (2, 60, 70)).astype(np.float32)
    uv = np.array([[20.0, 30.0], [40.0, 25.0]])
    product = correlation_product(first, uv, second, uv)
    for i, (u, v) in enumerate(uv.astype(int)):
        for j, (x, y) in enumerate(uv.astype(int)):
            expected = 0.0
            for a, b in ((first, second), (edge_image(first), edge_image(second))):
                one, two = a[v - 7 : v + 8, u - 7 : u + 8], b[y - 7 : y + 8, x - 7 : x + 8]
                expected += np.corrcoef(one.ravel(), two.ravel())[0, 1] / 2
            assert abs(product[i, j] - expected) < 1e-5


def test_flat_windows_correlate_with_nothing() -> None:
    assert not windows_at(np.full((30, 30), 5.0, np.float32), np.array([[15.0, 15.0]])).any()
    assert not unit_rows(np.ones((2, 9), np.float32)).any()


def test_only_unique_and_mutual_best_matches_are_kept() -> None:
    score = np.array([[0.9, 0.5, 0.1], [0.8, 0.79, 0.0], [0.95, 0.2, 0.1]])
    first, second, value = unique_matches(score, margin=0.1)
    assert (first.tolist(), second.tolist(), value.tolist()) == ([2], [0], [0.95])
    literal, _, _ = unique_matches(score, margin=0.1, mutual=False)
    assert literal.tolist() == [0, 2]
    for shape in ((0, 3), (3, 0), (3, 1)):
        assert not len(unique_matches(np.zeros(shape), margin=0.1)[0])


@pytest.mark.parametrize("side", [3, 9, 21])
@pytest.mark.parametrize("responses", [("gray",), ("edge",), ("gray", "edge")])
def test_any_side_and_responses_can_be_chosen(side: int, responses: Any) -> None:
    rng = np.random.default_rng(1)
    first, second = rng.uniform(0, 255, (2, 50, 60)).astype(np.float32)
    uv, half = np.array([[25.0, 30.0]]), side // 2
    expected = []
    for response in responses:
        a, b = (image if response == "gray" else edge_image(image) for image in (first, second))
        one, two = (w[30 - half : 31 + half, 25 - half : 26 + half].ravel() for w in (a, b))
        expected.append(np.corrcoef(one, two)[0, 1])
    product = correlation_product(first, uv, second, uv, side_px=side, responses=responses)
    assert abs(product[0, 0] - np.mean(expected)) < 1e-5
    assert correlation_rows(first, uv, side_px=side, responses=responses).shape == (1, len(responses) * side**2)


def test_equal_corners_are_never_matched() -> None:
    """Ties are removed at T1 = 0 as well, although scores of equal windows differ in their last digits."""
    rng = np.random.default_rng(2)
    tile = rng.uniform(0, 255, (40, 40)).astype(np.float32)
    photo = np.tile(tile, (2, 3))
    at = np.array([[20.0, 20.0]])
    copies = np.array([[20.0 + 40 * j, 20.0 + 40 * i] for i in range(2) for j in range(3)])
    others = rng.uniform(10, 70, (40, 2)) + 0.25
    score = correlation_product(tile, at, photo, np.vstack([copies, others]))
    assert not len(unique_matches(score, margin=0.0, mutual=False)[0])
    assert len(unique_matches(score[:, 5:], margin=0.0, mutual=False)[0]) == 1
    exact = np.array([[0.7, 0.7, 0.1]])
    assert not len(unique_matches(exact, margin=0.0, mutual=False)[0])


@given(st.integers(0, 10_000), st.floats(0, 0.5))
def test_matches_follow_the_rule(seed: int, margin: float) -> None:
    score = np.random.default_rng(seed).uniform(-1, 1, (6, 5))
    first, second, value = unique_matches(score, margin=margin, mutual=False)
    expected = [i for i, row in enumerate(score) if np.subtract(*np.sort(row)[[-1, -2]]) > max(margin, 1e-6)]
    assert first.tolist() == expected
    np.testing.assert_array_equal(second, score[first].argmax(axis=1))
    np.testing.assert_array_equal(value, score[first].max(axis=1))


def test_the_floor_replaces_a_missing_second_best() -> None:
    score = np.array([[0.5], [0.25], [-np.inf]])
    assert unique_matches(score, margin=0.1, mutual=False, c2_floor=0.3)[0].tolist() == [0]
    assert not len(unique_matches(score, margin=0.1, mutual=False)[0])
    among = np.array([[0.9, -np.inf, 0.2], [-np.inf, -np.inf, -np.inf]])
    assert unique_matches(among, margin=0.3, c2_floor=0.5)[0].tolist() == [0]
    assert not len(unique_matches(among, margin=0.3, c2_floor=0.65)[0])


@pytest.mark.parametrize("side", [0, 1, 2, 14, -15, 103, 15.0, True, "15"])
def test_an_invalid_window_side_is_refused(side: Any) -> None:
    with pytest.raises(OptionError, match="odd number"):
        windows_at(np.zeros((30, 30), np.float32), np.array([[15.0, 15.0]]), side_px=side)


def test_other_invalid_arguments_are_refused() -> None:
    picture, uv = np.ones((30, 30), np.float32), np.array([[15.0, 15.0]])
    for responses in ((), ("depth",)):
        with pytest.raises(OptionError, match="gray, edge"):
            correlation_rows(picture, uv, responses=responses)  # type: ignore[arg-type]
    for bad in (np.zeros((3, 3)), np.zeros(2), np.array([[np.nan, 1.0]])):
        with pytest.raises(ShapeError, match=r"\(N, 2\)"):
            correlation_rows(picture, bad)
    for margin in (-0.1, np.nan):
        with pytest.raises(OptionError, match="T1"):
            unique_matches(np.eye(3), margin=margin)


def test_no_corners_give_an_empty_product() -> None:
    picture, none = np.ones((30, 30), np.float32), np.zeros((0, 2))
    assert correlation_product(picture, none, picture, np.array([[15.0, 15.0]])).shape == (0, 1)
    assert correlation_product(picture, none, picture, none).shape == (0, 0)
