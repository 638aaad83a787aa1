"""Disparity filter and guided matching: predictions, search windows, and the best of few candidates."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from ladarreg_core.camera import Camera
from ladarreg_core.errors import LadarregError, OptionError, ShapeError
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid, rotation_from_rotvec
from ladarreg_core.matching.features.correlation import unique_matches
from ladarreg_core.thesis.matching.search import (
    candidates_near,
    consistent_displacements,
    disparities,
    matches_near,
    predicted_pixels,
    recentred,
    within_disparity,
)

CAMERA = Camera.from_focal(320, 240, 400.0)
POSE = Rigid.from_centre(CAMERA_AXES_FROM_SCANNER, (0.1, -0.3, 0.05))
PIXELS = st.floats(0, 300, allow_nan=False, width=32)


def scene(seed: int, count: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """Return scan points in front of the camera and their pixels in the photo."""
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(2, 5, count), rng.uniform(-0.7, 0.3, count), rng.uniform(-0.4, 0.4, count)])
    return points, CAMERA.project(POSE @ points)


def test_predictions_of_the_true_pose_are_exact() -> None:
    points, uv = scene(0)
    np.testing.assert_allclose(predicted_pixels(points, CAMERA, POSE), uv)
    outside = np.array([[-3.0, 0, 0], [3, 5, 0], [0.1, -0.3, 0.05], [np.nan, 0, 0], [np.inf, 0, 0]])
    assert np.isnan(predicted_pixels(outside, CAMERA, POSE)).all()
    beside = CAMERA.unproject([[-8.0, 100.0]]) @ POSE.rotation * 3 + POSE.centre
    assert np.isnan(predicted_pixels(beside, CAMERA, POSE)).all()
    np.testing.assert_allclose(predicted_pixels(beside, CAMERA, POSE, border_px=10), [[-8, 100]], atol=1e-9)


@given(
    hnp.arrays(np.float64, (7, 2), elements=PIXELS),
    hnp.arrays(np.float64, (9, 2), elements=PIXELS),
    st.floats(1, 400),
)
def test_candidates_lie_in_the_square_window(expected: np.ndarray, photo: np.ndarray, half: float) -> None:
    near = candidates_near(expected, photo, search_px=half)
    np.testing.assert_array_equal(near, np.abs(expected[:, None] - photo).max(axis=-1) <= half)
    gone = np.where(np.arange(7)[:, None] == 3, np.nan, expected)
    assert not candidates_near(gone, photo, search_px=half)[3].any()


def test_guided_matching_finds_many_more_matches() -> None:
    """Similar corners all over the image are distinguished only by the search window."""
    _, uv = scene(1)
    rng = np.random.default_rng(1)
    score = 0.6 + 0.05 * rng.random((60, 60)) + 0.1 * np.eye(60)
    anywhere, _, _ = unique_matches(score, margin=0.2, mutual=False)
    assert not len(anywhere)
    near = candidates_near(uv, uv, search_px=8)
    first, second, value = matches_near(score, near, margin=0.05, least_score=0.3, mutual=False)
    assert len(first) > 45
    np.testing.assert_array_equal(first, second)
    np.testing.assert_array_equal(value, score[first, second])


@given(st.integers(0, 10_000), st.floats(0, 0.3), st.floats(0, 0.9))
def test_matches_equal_those_of_a_plain_loop(seed: int, margin: float, least: float) -> None:
    rng = np.random.default_rng(seed)
    score, near = rng.uniform(-1, 1, (8, 6)), rng.random((8, 6)) < 0.4
    expected = []
    for i in range(8):
        among = sorted(((score[i, j], j) for j in range(6) if near[i, j]), reverse=True)
        rivals = [least] + [value for value, _ in among[1:2]]
        if among and among[0][0] - max(rivals) > max(margin, 1e-6):
            expected.append((i, among[0][1]))
    first, second, _ = matches_near(score, near, margin=margin, least_score=least, mutual=False)
    assert list(zip(first.tolist(), second.tolist(), strict=True)) == expected
    one, other, _ = matches_near(score, near, margin=margin, least_score=least, mutual=True)
    assert len(set(other.tolist())) == len(other)
    assert set(zip(one.tolist(), other.tolist(), strict=True)) <= set(expected)


def test_a_single_candidate_must_exceed_the_least_score() -> None:
    near = np.array([[True], [True], [False]])
    first, _, _ = matches_near(np.array([[0.9], [0.32], [0.99]]), near, margin=0.05, least_score=0.3, mutual=False)
    assert first.tolist() == [0]
    for shape in ((0, 0), (0, 5), (5, 0), (4, 3)):
        empty = np.zeros(shape, np.bool_)
        assert not len(matches_near(np.ones(shape), empty, margin=0.1, least_score=0.3, mutual=True)[0])


def test_matches_of_a_large_window_recentre_the_predictions() -> None:
    points, uv = scene(2, count=200)
    off = Rigid(rotation_from_rotvec(np.deg2rad([1.0, -2.0, 2.0])) @ POSE.rotation, POSE.translation)
    expected = predicted_pixels(points, CAMERA, off, border_px=100)
    known = np.flatnonzero(np.isfinite(expected).all(axis=-1))
    assert np.median(np.hypot(*(uv - expected)[known].T)) > 12
    found = np.arange(0, len(known), 2)
    shift = (uv - expected)[known[found]]
    rng = np.random.default_rng(2)
    wrong = rng.random(len(found)) < 0.2
    shift[wrong] += rng.uniform(-60, 60, (wrong.sum(), 2))
    moved = recentred(expected, expected[known[found]], shift)
    assert np.median(np.hypot(*(uv - moved)[known].T)) < 3
    np.testing.assert_array_equal(np.isnan(moved), np.isnan(expected))
    few = recentred(expected, expected[known[:4]], shift[:4])
    np.testing.assert_array_equal(few, expected)


@given(hnp.arrays(np.float64, (2,), elements=st.floats(-40, 40)), st.integers(0, 1000))
def test_a_common_displacement_removes_no_match(common: np.ndarray, seed: int) -> None:
    rng = np.random.default_rng(seed)
    shift = common + rng.uniform(-2, 2, (40, 2))
    shift[:8] += np.array([1.0, -1.0]) * rng.uniform(15, 40, (8, 1))
    kept = consistent_displacements(shift, most_px=7)
    assert not kept[:8].any()
    assert kept[8:].all()


def test_no_displacements_give_an_empty_mask() -> None:
    assert consistent_displacements(np.zeros((0, 2)), most_px=5).shape == (0,)


SIGNED_PIXELS = st.floats(-1000, 1000, allow_nan=False, width=32)
DISPARITIES = hnp.arrays(np.float64, st.integers(1, 30), elements=st.floats(0, 500, allow_nan=False, width=32))


def test_one_sided_filter_keeps_small_disparities() -> None:
    d = np.array([30.0, 31, 29, 35, 33, 2, 80, 49, 52.5])  # median 33
    assert np.flatnonzero(~within_disparity(d, t2_px=18)).tolist() == [5, 6, 8]
    assert np.flatnonzero(~within_disparity(d, t2_px=18, side="one_sided")).tolist() == [6, 8]


@given(hnp.arrays(np.float64, (12, 2), elements=SIGNED_PIXELS), hnp.arrays(np.float64, (12, 2), elements=SIGNED_PIXELS))
def test_disparity_is_symmetric_and_rotation_invariant(scan: np.ndarray, photo: np.ndarray) -> None:
    d = disparities(scan, photo)
    np.testing.assert_allclose(d, np.linalg.norm(scan - photo, axis=1), atol=1e-9)
    np.testing.assert_array_equal(d, disparities(photo, scan))
    quarter = np.array([[0.0, -1.0], [1.0, 0.0]])
    np.testing.assert_allclose(d, disparities(scan @ quarter.T, photo @ quarter.T), atol=1e-9)


@given(DISPARITIES, st.floats(0.5, 100), st.floats(0, 300, width=32))
def test_laws_of_the_disparity_filter(d: np.ndarray, t2: float, common: float) -> None:
    both, literal = within_disparity(d, t2_px=t2), within_disparity(d, t2_px=t2, side="one_sided")
    np.testing.assert_array_equal(both, np.abs(d - np.median(d)) <= t2)
    assert (literal | ~both).all()  # the one-sided filter keeps whatever the two-sided one keeps
    assert literal.sum() >= (len(d) + 1) // 2  # at least what is not above the median
    mixed = np.concatenate([d, [np.nan, np.inf]])
    np.testing.assert_array_equal(within_disparity(mixed, t2_px=t2), [*both, False, False])
    far = np.abs(np.abs(d - np.median(d)) - t2) > 1e-6
    np.testing.assert_array_equal(within_disparity(d + common, t2_px=t2)[far], both[far])


def test_empty_input_gives_an_empty_mask() -> None:
    assert within_disparity(np.zeros(0)).shape == (0,)
    assert disparities(np.zeros((0, 2)), np.zeros((0, 2))).shape == (0,)
    assert not within_disparity(np.array([np.nan, np.inf])).any()


@pytest.mark.parametrize("t2", [0, -3, np.nan, np.inf, "20", None, True])
def test_an_invalid_threshold_is_refused(t2: object) -> None:
    with pytest.raises(OptionError, match="T2"):
        within_disparity(np.arange(4.0), t2_px=t2)  # type: ignore[arg-type]


def test_invalid_arrays_and_sides_raise_a_one_line_error() -> None:
    for call in (
        lambda: disparities(np.zeros((3, 2)), np.zeros((4, 2))),
        lambda: disparities(np.zeros((3, 3)), np.zeros((3, 3))),
        lambda: within_disparity(np.zeros((2, 2))),
    ):
        with pytest.raises(ShapeError) as caught:
            call()
        assert "\n" not in str(caught.value)
    with pytest.raises(LadarregError, match="one of two_sided, one_sided"):
        within_disparity(np.arange(4.0), side="both")  # type: ignore[arg-type]
