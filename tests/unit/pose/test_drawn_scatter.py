"""Lines drawn by hand: their noise is found however sloppy the hand, and the sigma counts what they disagree by."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ladarreg_core.matches import Matches, Pick
from ladarreg_core.picks.measure import matches_from_picks
from ladarreg_core.pose.acceptance import count_independent, more_matches
from ladarreg_core.pose.estimate import PoseOptions, solve_pose
from ladarreg_core.results.registration import PoseResult
from testing.scenes.pose_case import difference
from testing.scenes.room_lines import LineCase, line_case

SHELF_PX = 12.0
LINES = 8


def drawn(seed: int, scatter_px: float, *, wrong: bool) -> LineCase:
    """Return lines with so much scatter in the photo, one of them along the other edge of a shelf."""
    case = line_case(seed, lines=LINES)
    rng = np.random.default_rng([seed, 39])
    picks = []
    for k, pick in enumerate(case.picks):
        photo = pick.photo + rng.normal(0, scatter_px, (2, 2))
        along = (photo[1] - photo[0]) / np.linalg.norm(photo[1] - photo[0])
        if wrong and k == seed % LINES:
            photo = photo + SHELF_PX * np.array([-along[1], along[0]])
        picks.append(Pick(pick.id, "line", pick.scan, photo))
    return replace(case, picks=tuple(picks))


def solved(case: LineCase) -> PoseResult:
    matches, _ = matches_from_picks(case.scan, case.picks, camera=case.camera)
    return solve_pose(matches, case.camera, PoseOptions(check_ambiguity=False, intrinsics="fixed"))


def sigmas(case: LineCase, result: PoseResult) -> float:
    """Return the distance from the true pose in standard deviations, per parameter."""
    off = difference(case.pose, result.camera_from_scanner)
    return float(np.sqrt(off @ np.linalg.solve(result.covariance, off) / 6))


def test_sloppy_lines_agree_on_a_noise_as_large_as_theirs() -> None:
    found = [solved(drawn(seed, 4.0, wrong=False)) for seed in range(6)]
    assert all(np.mean(result.inliers) > 0.8 for result in found)
    assert 3.0 < np.median([result.sigma_px for result in found]) < 7.0


@pytest.mark.long
def test_the_sigma_is_right_with_a_line_along_the_wrong_edge() -> None:
    cases = [drawn(seed, 2.0, wrong=True) for seed in range(24)]
    found = np.array([sigmas(case, solved(case)) for case in cases])
    assert 0.6 < np.sqrt(np.mean(found**2)) < 1.3
    assert (found < 5).all()


def test_a_line_counts_two_however_often_it_is_sampled() -> None:
    case = line_case(3, lines=4)
    ends, _ = matches_from_picks(case.scan, case.picks, camera=case.camera)
    samples, _ = matches_from_picks(case.scan, case.picks, camera=case.camera, lines="equal", samples_per_line=9)
    for matches in (ends, samples):
        assert count_independent(matches, np.ones(len(matches), np.bool_)) == 8
    assert count_independent(Matches.none(), np.zeros(0, np.bool_)) == 0


def test_what_is_missing_is_said_in_lines_and_points() -> None:
    assert more_matches(1) == "draw 1 more line, or 1 more point"
    assert more_matches(3) == "draw 2 more lines, or 3 more points"
