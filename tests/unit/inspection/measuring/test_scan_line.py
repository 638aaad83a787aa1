"""Lines drawn in a scan: their places against the true edge, their stated deviation, and what is refused or doubted."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from ladarreg_core.errors import OptionError
from ladarreg_core.inspection.measuring.scan_line import line_in_scan
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation

_STEP_RAD = 0.004
_NOISE_M = 0.003
_EDGE = [[1.0, 0.001, -0.2], [1.0, 0.001, 0.2]]


@cache
def room(seed: int = 0) -> Scan:
    """A wall at 4 m, whose left half is at 3 m, with a hole in the right one."""
    geometry = AzimuthElevation(200, 300, _STEP_RAD, _STEP_RAD)
    rays = geometry.rays
    ranges = np.where(rays[..., 1] > 0, 3.0, 4.0) / rays[..., 0]
    ranges = ranges + np.random.default_rng(seed).normal(size=ranges.shape) * _NOISE_M
    at = rays[..., 1:] / rays[..., :1]
    ranges[(np.abs(at - [-0.3, 0.1]) < 0.05).all(axis=-1)] = np.nan
    return Scan(geometry, ranges, np.ones(ranges.shape))


@pytest.mark.parametrize(
    ("rays", "xyz"),
    [
        (_EDGE, [[3, 0, -0.6], [3, 0, 0.6]]),
        ([[1, -0.003, -0.2], [1, -0.003, 0.2]], [[3, 0, -0.6], [3, 0, 0.6]]),  # beside it: the nearer surface's
        ([[2, -0.1, -0.2], [4, -1.2, 0.4]], [[4, -0.2, -0.4], [4, -1.2, 0.4]]),
        ([[1, -0.55, 0.1], [1, -0.32, 0.1]], [[4, -2.2, 0.4], [4, -1.28, 0.4]]),  # it ends in the hole
    ],
    ids=["outline", "beside the outline", "wall", "hole"],
)
def test_the_ends_get_the_ranges_of_the_straight_edge_under_the_line(
    rays: list[list[float]], xyz: list[list[float]]
) -> None:
    found = line_in_scan(room(), rays)
    assert np.abs(found.xyz - xyz).max() < 0.015
    assert found.notes == ()


@pytest.mark.parametrize("rays", [_EDGE, [[1, -0.1, -0.2], [1, -0.3, 0.4]]], ids=["outline", "wall"])
@pytest.mark.parametrize("sigma_rad", [0.0, 0.006])
def test_the_stated_deviation_is_that_of_lines_drawn_again(rays: list[list[float]], sigma_rad: float) -> None:
    rng, ends = np.random.default_rng(1), np.array(rays)
    ends /= np.linalg.norm(ends, axis=1, keepdims=True)
    drawn = [
        line_in_scan(room(k % 5), ends + rng.normal(0, max(sigma_rad, 0.5 * _STEP_RAD), (2, 3)), sigma_rad=sigma_rad)
        for k in range(150)
    ]
    middle = np.median([one.xyz for one in drawn], axis=0)
    across = np.linalg.svd((middle[1] - middle[0])[None])[2][1:]
    off = np.array([(one.xyz - middle) @ across.T for one in drawn])
    deviation = 1.4826 * np.median(np.abs(off), axis=0).max()  # some are drawn on the other surface
    stated = float(np.median([one.sigma_m for one in drawn]))
    assert deviation / 1.2 < stated < 1.7 * deviation


@pytest.mark.parametrize(
    ("rays", "words"),
    [
        ([[1, -0.3, 0], [1, -0.3, 0]], "no length in the scan"),
        ([[1, -0.3, 0], [-1, -0.3, 0]], "second end is outside the scan"),
        ([[1, -0.3, 0.1], [1, -0.31, 0.12]], "first end has no return: pick on a surface"),
    ],
)
def test_what_has_no_place_in_the_scan_is_refused(rays: list[list[float]], words: str) -> None:
    with pytest.raises(OptionError, match=words):
        line_in_scan(room(), rays)


def test_an_end_on_another_surface_than_most_of_the_line_is_doubted() -> None:
    (note,) = line_in_scan(room(), [[1, -0.4, -0.1], [1, 0.1, -0.1]]).notes
    assert note.startswith("The second end lies on another surface than most of the line, 1.0")


def test_between_two_surfaces_only_the_ends_count() -> None:
    geometry = AzimuthElevation(100, 200, _STEP_RAD, _STEP_RAD)
    rng = np.random.default_rng(2)
    scan = Scan(
        geometry,
        4 + 0.3 * np.sin(40 * geometry.rays[..., 1]) + rng.normal(0, _NOISE_M, (100, 200)),
        np.ones((100, 200)),
    )
    found = line_in_scan(scan, [[1, -0.2, 0], [1, 0.2, 0.05]])
    assert found.notes[0].startswith("The surface under the line is not straight")
    assert np.abs(np.linalg.norm(found.xyz, axis=1) - 4).max() < 0.4
