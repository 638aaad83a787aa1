"""Two wrong lines among eleven are suspected before the lens, whatever method found the pose."""

from dataclasses import replace

import numpy as np
import pytest

from ladarreg_core.errors import LadarregError
from ladarreg_core.picks.measure import matches_from_picks
from ladarreg_core.pose.estimate import PoseOptions, solve_pose
from ladarreg_core.quality.findings import LEVELS, findings
from ladarreg_core.quality.suspects import agreeing_picks, suspect_matches
from testing.scenes.room_lines import line_case

WRONG = {"L4", "L9"}


@pytest.fixture(scope="module", params=range(3))
def drawn(request):
    """Matches of eleven lines, two of them drawn along other edges, and the camera."""
    case = line_case(request.param, lines=11)
    rng = np.random.default_rng(request.param)
    picks = [
        replace(pick, photo=pick.photo + rng.uniform(25, 40, 2) * [[1], [-1]]) if pick.id in WRONG else pick
        for pick in case.picks
    ]
    return matches_from_picks(case.scan, picks, camera=case.camera)[0], case


@pytest.mark.parametrize("method", ["robust", "linear", "epipolar_simplex"])
def test_wrong_lines_are_suspected_before_the_lens(drawn, method):
    matches, case = drawn
    try:
        result = solve_pose(matches, case.camera, PoseOptions(method=method), initial=case.pose)
    except LadarregError:
        pytest.skip("the method finds no pose among wrong lines")
    assert set(suspect_matches(result).pick_ids) == WRONG
    assert {name for name, agrees in agreeing_picks(result).items() if not agrees} == WRONG
    found = [finding for finding in findings(result) if finding.level != "good"]
    ordered = sorted(found, key=lambda finding: -LEVELS.index(finding.level))  # as shown: the worst first
    names = [finding.name for finding in ordered]
    inliers = ordered[names.index("inliers")]
    assert all(name in inliers.sentence for name in WRONG)
    assert "lens" not in names[: names.index("inliers")]


def test_correct_lines_are_not_suspected():
    case = line_case(5, lines=11)
    matches, _ = matches_from_picks(case.scan, case.picks, camera=case.camera)
    result = solve_pose(matches, case.camera, PoseOptions(method="linear"))
    assert suspect_matches(result).pick_ids == ()
