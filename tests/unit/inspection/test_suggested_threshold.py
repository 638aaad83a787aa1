"""The suggested threshold never rejects what the robust estimator accepts."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ladarreg_core.inspection.picks import suggested_threshold

GOOD = [0.31, -0.42, 0.38, 0.0127, -0.44, 0.4351, 0.29, -0.33, 0.27]
WRONG = [0.12, -0.9]
"""Errors under a pose that two wrong matches have pulled towards them."""
AGREES = [True] * len(GOOD) + [False] * len(WRONG)


@pytest.mark.parametrize("sigmas", [0.5, 1, 3])
def test_it_rests_on_the_robust_inliers(sigmas: float) -> None:
    above = suggested_threshold([*GOOD, *WRONG], AGREES, sigmas=sigmas)
    assert above is not None
    assert max(map(abs, GOOD)) <= above
    if sigmas == 0.5:
        assert above == 0.44, "rounded up to two figures: not one right match is beyond"


def test_it_is_a_multiple_of_the_robust_standard_deviation() -> None:
    errors = np.random.default_rng(1).normal(scale=0.02, size=4001)
    assert suggested_threshold(errors, np.zeros(4001, bool), sigmas=3) == pytest.approx(0.06, rel=0.06)


@pytest.mark.parametrize("largest", [9.99, 0.0991, 1e-7, 123.4, 0.3000001])
def test_it_is_never_below_the_largest_right_error(largest: float) -> None:
    above = suggested_threshold([largest, 0, 0], [True] * 3, sigmas=1)
    assert above is not None
    assert largest <= above <= 1.2 * largest


def test_without_errors_there_is_none() -> None:
    assert suggested_threshold([], [], sigmas=3) is None
    assert suggested_threshold([math.nan], [True], sigmas=3) is None
    assert suggested_threshold([0.0, 0.0], [True, True], sigmas=3) is None
