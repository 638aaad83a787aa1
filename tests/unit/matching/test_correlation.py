"""The correlation product and the choice of unique matches."""

from __future__ import annotations

import numpy as np

from ladarreg_core.features.descriptors import unit_rows
from ladarreg_core.matching.correlation import correlation_product, edge_picture, unique_matches, windows_at


def test_the_product_is_the_mean_of_two_correlation_coefficients() -> None:
    rng = np.random.default_rng(0)
    first, second = rng.uniform(0, 255, (2, 60, 70)).astype(np.float32)
    uv = np.array([[20.0, 30.0], [40.0, 25.0]])
    product = correlation_product(first, uv, second, uv)
    for i, (u, v) in enumerate(uv.astype(int)):
        for j, (x, y) in enumerate(uv.astype(int)):
            expected = 0.0
            for a, b in ((first, second), (edge_picture(first), edge_picture(second))):
                one, two = a[v - 7 : v + 8, u - 7 : u + 8], b[y - 7 : y + 8, x - 7 : x + 8]
                expected += np.corrcoef(one.ravel(), two.ravel())[0, 1] / 2
            assert abs(product[i, j] - expected) < 1e-5


def test_flat_windows_correlate_with_nothing() -> None:
    assert not windows_at(np.full((30, 30), 5.0, np.float32), np.array([[15.0, 15.0]])).any()
    assert not unit_rows(np.ones((2, 9), np.float32)).any()


def test_only_clear_and_mutual_winners_are_kept() -> None:
    score = np.array([[0.9, 0.5, 0.1], [0.8, 0.79, 0.0], [0.95, 0.2, 0.1]])
    first, second, value = unique_matches(score, margin=0.1)
    assert (first.tolist(), second.tolist(), value.tolist()) == ([2], [0], [0.95])
    literal, _, _ = unique_matches(score, margin=0.1, mutual=False)
    assert literal.tolist() == [0, 2]
    for shape in ((0, 3), (3, 0), (3, 1)):
        assert not len(unique_matches(np.zeros(shape), margin=0.1)[0])
