"""The second search: predictions, windows around them, and the winners among few candidates."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from ladarreg_core.camera import Camera
from ladarreg_core.features.correlation import unique_matches
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid, rotation_from_rotvec
from ladarreg_core.matching.thesis.search import (
    candidates_near,
    consistent_displacements,
    matches_near,
    predicted_pixels,
    recentred,
)

CAMERA = Camera.from_focal(320, 240, 400.0)
POSE = Rigid.from_centre(CAMERA_AXES_FROM_SCANNER, (0.1, -0.3, 0.05))
PIXELS = st.floats(0, 300, allow_nan=False, width=32)


def scene(seed: int, count: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """Scan points in front of the camera, and where they are in the photo."""
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(2, 5, count), rng.uniform(-0.7, 0.3, count), rng.uniform(-0.4, 0.4, count)])
    return points, CAMERA.project(POSE @ points)


def test_the_true_pose_predicts_every_point_and_nothing_else_is_predicted() -> None:
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
def test_candidates_are_those_in_the_square_window(expected: np.ndarray, photo: np.ndarray, half: float) -> None:
    near = candidates_near(expected, photo, search_px=half)
    np.testing.assert_array_equal(near, np.abs(expected[:, None] - photo).max(axis=-1) <= half)
    gone = np.where(np.arange(7)[:, None] == 3, np.nan, expected)
    assert not candidates_near(gone, photo, search_px=half)[3].any()


def test_few_rivals_leave_many_more_matches() -> None:
    """Look-alikes all over the picture: only the window tells which is meant."""
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
def test_the_winners_are_what_a_plain_loop_finds(seed: int, margin: float, least: float) -> None:
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


def test_a_single_candidate_must_be_good_and_none_is_none() -> None:
    near = np.array([[True], [True], [False]])
    first, _, _ = matches_near(np.array([[0.9], [0.32], [0.99]]), near, margin=0.05, least_score=0.3, mutual=False)
    assert first.tolist() == [0]
    for shape in ((0, 0), (0, 5), (5, 0), (4, 3)):
        empty = np.zeros(shape, np.bool_)
        assert not len(matches_near(np.ones(shape), empty, margin=0.1, least_score=0.3, mutual=True)[0])


def test_a_large_window_brings_the_small_one_to_its_place() -> None:
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
def test_a_pose_that_is_wrong_everywhere_alike_culls_nobody(common: np.ndarray, seed: int) -> None:
    rng = np.random.default_rng(seed)
    shift = common + rng.uniform(-2, 2, (40, 2))
    shift[:8] += np.array([1.0, -1.0]) * rng.uniform(15, 40, (8, 1))
    kept = consistent_displacements(shift, most_px=7)
    assert not kept[:8].any()
    assert kept[8:].all()


def test_no_displacements_are_no_matches() -> None:
    assert consistent_displacements(np.zeros((0, 2)), most_px=5).shape == (0,)
