"""The normalised information distance: laws, and refinement of a pose with an arbitrary mapping of gray levels."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import ladarreg_core as lr
from benchmarks.matching.nid import BINS, NidPair, nid, rank_bins
from ladarreg_core.errors import OptionError, ShapeError
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from testing.scenes.painted_room import PaintedRoom, painted_room

VALUES = arrays(np.float64, st.integers(2, 300), elements=st.integers(-20, 20).map(float))


@pytest.mark.slow
@given(VALUES)
def test_the_distance_of_equal_images_is_zero(values: np.ndarray) -> None:
    assert nid(values, values) == pytest.approx(0 if len(set(rank_bins(values))) > 1 else 1, abs=1e-12)


@given(VALUES, st.data())
def test_the_distance_is_symmetric_and_between_0_and_1(values: np.ndarray, data: st.DataObject) -> None:
    other = data.draw(arrays(np.float64, len(values), elements=st.floats(-5, 5)))
    distance = nid(values, other)
    assert 0 <= distance <= 1
    assert distance == pytest.approx(nid(other, values), abs=1e-12)


@given(VALUES)
def test_bins_depend_on_the_order_only(values: np.ndarray) -> None:
    assert (rank_bins(np.exp(values / 5)) == rank_bins(values)).all()


@given(st.integers(BINS, 2000), st.integers(0, 5))
def test_bins_have_equal_counts(count: int, seed: int) -> None:
    values = np.random.default_rng(seed).permutation(count)
    held = np.bincount(rank_bins(values), minlength=BINS)
    assert held.max() - held.min() <= 1


def test_the_distance_is_invariant_to_permutation_of_bins() -> None:
    rng = np.random.default_rng(0)
    values = rng.random(16 * 500)
    bins = rank_bins(values)
    assert nid(values, rng.permutation(BINS)[bins]) == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_the_distance_of_independent_images_has_its_expected_value(seed: int) -> None:
    """For independent images I is chi^2 / 2n with (B - 1)^2 degrees of freedom."""
    rng = np.random.default_rng(seed)
    n = 20_000
    information = 225 / (2 * n)
    expected = 1 - information / (2 * np.log(BINS) - information)
    spread = np.sqrt(2 * 225) / (2 * n) / (2 * np.log(BINS))
    assert abs(nid(rng.random(n), rng.random(n)) - expected) < 5 * spread


@pytest.mark.parametrize(
    ("first", "second"),
    [([1.0, np.nan], [1.0, 2.0]), ([1.0], [1.0, 2.0]), ([[1.0]], [1.0])],
    ids=["NaN", "unequal", "two axes"],
)
def test_invalid_pairs_are_refused(first: object, second: object) -> None:
    with pytest.raises(ShapeError):
        nid(first, second)  # type: ignore[arg-type]


def test_a_single_bin_is_refused() -> None:
    with pytest.raises(OptionError):
        rank_bins([1.0, 2.0], bins=1)


@pytest.fixture(scope="module")
def room() -> PaintedRoom:
    return painted_room(seed=2)


@pytest.fixture(scope="module")
def pair(room: PaintedRoom) -> NidPair:
    """Return the scan with the photo under a non-monotone gray-level curve, so that no gray level is shared."""
    cells = room.scan.valid
    points, laser = room.scan.points[cells][::9], room.scan.intensity[cells][::9]
    ranges = np.linalg.norm(points, axis=-1)
    gray = room.photo.pixels[..., 0].astype(np.float32)
    odd = 127 + 127 * np.sin(gray / 28)
    return NidPair(points.astype(float), laser * ranges**2, odd, room.photo.camera)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_refinement_reduces_error_and_score(room: PaintedRoom, pair: NidPair, seed: int) -> None:
    rng = np.random.default_rng(seed)
    turn = rng.normal(0, 1, 3)
    turn *= np.radians(0.8) / np.linalg.norm(turn)
    start = Rigid.from_centre(
        rotation_from_rotvec(turn) @ room.camera_from_scanner.rotation, room.camera_from_scanner.centre
    )
    found, score = pair.refine(start)
    assert score < pair.score(start)
    assert score == pair.score(found)
    assert room.error_px(found) < 0.7 * room.error_px(start)


def test_the_true_pose_scores_better_than_its_neighbours(room: PaintedRoom, pair: NidPair) -> None:
    true = pair.score(room.camera_from_scanner)
    for axis in range(3):
        for degrees in (-3, 3):
            turn = rotation_from_rotvec(np.radians(degrees) * np.eye(3)[axis])
            beside = Rigid.from_centre(turn @ room.camera_from_scanner.rotation, room.camera_from_scanner.centre)
            assert pair.score(beside) > true


def test_a_camera_facing_away_has_the_worst_score(room: PaintedRoom, pair: NidPair) -> None:
    away = Rigid.from_centre(np.diag([-1.0, 1.0, -1.0]) @ room.camera_from_scanner.rotation, (0, 0, 0))
    assert pair.score(away) == 1.0
    assert pair.score(room.camera_from_scanner, visible=np.zeros(len(pair.points), np.bool_)) == 1.0


def test_inconsistent_arguments_are_refused(pair: NidPair) -> None:
    with pytest.raises(ShapeError):
        NidPair(pair.points, pair.values[1:], pair.gray, pair.camera)
    with pytest.raises(ShapeError):
        NidPair(np.full((3, 3), np.nan), np.zeros(3), pair.gray, pair.camera)
    with pytest.raises(ShapeError):
        NidPair(pair.points, pair.values, pair.gray[1:], pair.camera)
    with pytest.raises(OptionError):
        pair.refine(lr.Rigid.identity(), step_m=0.0)
