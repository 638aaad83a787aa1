"""Lines drawn by hand become points at constant intervals, and what the scan did not measure is said."""

from __future__ import annotations

import numpy as np
import pytest

from ladarreg_core.errors import OptionError
from ladarreg_core.matches import Pick
from ladarreg_core.picks.measure import matches_from_picks
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation
from ladarreg_core.surface.perspective import perspective_view
from ladarreg_core.surface.ranges import surface_range

STEP_RAD = np.deg2rad(0.2)


def stepped_scan() -> Scan:
    """A wall 3 m ahead whose right half stands 1 m further back, and a hole in the left half."""
    geometry = AzimuthElevation(120, 160, STEP_RAD, STEP_RAD)
    rays = geometry.rays
    depth = np.where(np.arange(160) < 80, 3.0, 4.0)
    ranges = depth / rays[..., 0]
    ranges[50:70, 20:40] = np.nan
    return Scan(geometry, ranges, np.ones((120, 160)))


def line(scan: Scan, first: tuple[float, float], last: tuple[float, float], name: str = "l") -> Pick:
    rays = scan.geometry.rays[(first[0], last[0]), (first[1], last[1])]
    return Pick(name, "line", rays, np.array([[10.0, 20.0], [110.0, 70.0]]))


@pytest.mark.parametrize("count", [2, 5, 9, 33])
def test_a_line_is_sampled_at_constant_intervals_on_both_sides(count: int) -> None:
    scan = stepped_scan()
    pick = line(scan, (5, 45), (110, 75))
    matches, notes = matches_from_picks(scan, [pick], lines="equal", samples_per_line=count)
    assert notes == ()
    assert len(matches) == count
    np.testing.assert_allclose(matches.uv, pick.photo[0] + matches.fractions[:, None] * (pick.photo[1] - pick.photo[0]))
    np.testing.assert_allclose(matches.weights, 1 / np.sqrt(count))
    # As seen from the scanner the points lie on the drawn line, at equal steps of a picture that faces it.
    view = perspective_view(scan, whole_scan=True)
    uv = view.project(matches.rays)
    ends = view.project(pick.scan)
    along = (uv - ends[0]) @ (ends[1] - ends[0]) / ((ends[1] - ends[0]) ** 2).sum()
    across = (uv - ends[0]) - along[:, None] * (ends[1] - ends[0])
    assert np.abs(across).max() < 1e-6
    assert np.abs(along - matches.fractions).max() < 0.01
    np.testing.assert_allclose(matches.points[:, 0], 3.0, atol=1e-4)


def test_a_hole_and_a_depth_edge_are_told_apart() -> None:
    scan = stepped_scan()
    hole, edge, fine = (
        line(scan, (60, 5), (60, 55), "a"),
        line(scan, (20, 79), (100, 80), "b"),
        line(scan, (10, 100), (100, 150), "c"),
    )
    matches, notes = matches_from_picks(scan, [hole, edge, fine], lines="equal", samples_per_line=11)
    assert len(notes) == 2
    assert notes[0].startswith("Match a: 4 of 11 points are left out, 4 without a return.")
    assert notes[1] == "Match b: 10 of 11 points are left out, 10 at a depth edge."
    assert matches.pick_ids.count("a") == 7
    assert matches.pick_ids.count("c") == 11


def test_nothing_is_measured_between_foreground_and_background() -> None:
    scan = stepped_scan()
    rays = scan.geometry.rays[60, 70:90]
    between = rays[:-1] + rays[1:]
    between /= np.linalg.norm(between, axis=1, keepdims=True)
    found = surface_range(scan, between) * between[:, 0]
    assert np.isnan(found[9])
    known = np.isfinite(found)
    assert (np.minimum(np.abs(found[known] - 3), np.abs(found[known] - 4)) < 1e-4).all()


@pytest.mark.parametrize("count", [1, 0, -3, 2.5, "9", True, 10**6])
def test_a_number_of_samples_without_meaning_is_refused(count: object) -> None:
    scan = stepped_scan()
    with pytest.raises(OptionError, match="whole number from 2 to 1000"):
        matches_from_picks(scan, [line(scan, (5, 5), (9, 9))], samples_per_line=count)  # type: ignore[arg-type]
