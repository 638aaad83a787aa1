"""Disparity culling: the thesis's Steps 2-5, two-sided and to the letter."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from ladarreg_core.errors import LadarregError, OptionError, ShapeError
from ladarreg_core.matching.thesis.search import alike, disparities

PIXELS = st.floats(-1000, 1000, allow_nan=False, width=32)
LISTS = hnp.arrays(np.float64, st.integers(1, 30), elements=st.floats(0, 500, allow_nan=False, width=32))


def test_mismatches_are_culled_and_the_letter_keeps_what_moved_too_little() -> None:
    d = np.array([30.0, 31, 29, 35, 33, 2, 80, 49, 52.5])  # median 33
    assert np.flatnonzero(~alike(d, t2_px=18)).tolist() == [5, 6, 8]
    assert np.flatnonzero(~alike(d, t2_px=18, side="one_sided")).tolist() == [6, 8]


@given(hnp.arrays(np.float64, (12, 2), elements=PIXELS), hnp.arrays(np.float64, (12, 2), elements=PIXELS))
def test_a_disparity_is_a_distance_and_survives_a_common_turn(scan: np.ndarray, photo: np.ndarray) -> None:
    d = disparities(scan, photo)
    np.testing.assert_allclose(d, np.linalg.norm(scan - photo, axis=1), atol=1e-9)
    np.testing.assert_array_equal(d, disparities(photo, scan))
    quarter = np.array([[0.0, -1.0], [1.0, 0.0]])
    np.testing.assert_allclose(d, disparities(scan @ quarter.T, photo @ quarter.T), atol=1e-9)


@given(LISTS, st.floats(0.5, 100), st.floats(0, 300, width=32))
def test_the_laws_of_culling(d: np.ndarray, t2: float, common: float) -> None:
    both, literal = alike(d, t2_px=t2), alike(d, t2_px=t2, side="one_sided")
    np.testing.assert_array_equal(both, np.abs(d - np.median(d)) <= t2)
    assert (literal | ~both).all()  # the letter keeps whatever the two-sided rule keeps
    assert literal.sum() >= (len(d) + 1) // 2  # at least what is not above the median
    mixed = np.concatenate([d, [np.nan, np.inf]])
    np.testing.assert_array_equal(alike(mixed, t2_px=t2), [*both, False, False])
    far = np.abs(np.abs(d - np.median(d)) - t2) > 1e-6
    np.testing.assert_array_equal(alike(d + common, t2_px=t2)[far], both[far])


def test_nothing_culled_from_nothing() -> None:
    assert alike(np.zeros(0)).shape == (0,)
    assert disparities(np.zeros((0, 2)), np.zeros((0, 2))).shape == (0,)
    assert not alike(np.array([np.nan, np.inf])).any()


@pytest.mark.parametrize("t2", [0, -3, np.nan, np.inf, "20", None, True])
def test_a_threshold_without_meaning_is_refused(t2: object) -> None:
    with pytest.raises(OptionError, match="T2"):
        alike(np.arange(4.0), t2_px=t2)  # type: ignore[arg-type]


def test_arrays_that_disagree_and_unknown_sides_are_one_clear_line() -> None:
    for call in (
        lambda: disparities(np.zeros((3, 2)), np.zeros((4, 2))),
        lambda: disparities(np.zeros((3, 3)), np.zeros((3, 3))),
        lambda: alike(np.zeros((2, 2))),
    ):
        with pytest.raises(ShapeError) as caught:
            call()
        assert "\n" not in str(caught.value)
    with pytest.raises(LadarregError, match="one of two_sided, one_sided"):
        alike(np.arange(4.0), side="both")  # type: ignore[arg-type]
