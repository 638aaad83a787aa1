"""Textures of fewer cells lie where those of the whole scan do."""

from __future__ import annotations

import numpy as np
import pytest

from ladarreg_core.foundations.palette import VISIBILITY
from ladarreg_core.inspection.coarse_scan import CoarseScan
from ladarreg_core.inspection.model_textures import small_picture
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation


def scan_of(rows: int, columns: int) -> Scan:
    """A scan whose intensity is smooth, so that it can be compared at any resolution."""
    v, u = np.mgrid[:rows, :columns]
    light = 120 + 60 * np.sin(u / 23) + 50 * np.cos(v / 17)
    return Scan(AzimuthElevation(rows, columns, 0.002, 0.002), np.full((rows, columns), 4.0), light)


def picture_of(scan: Scan) -> np.ndarray:
    return np.repeat(np.rint(scan.intensity)[..., None], 3, axis=-1).astype(np.uint8)


@pytest.mark.parametrize(("shape", "longest_px"), [((301, 407), 130), ((240, 600), 150), ((333, 250), 60)])
def test_a_coarse_texture_lies_where_the_whole_one_does(shape: tuple[int, int], longest_px: int) -> None:
    scan = scan_of(*shape)
    shown = CoarseScan.of(scan, longest_px, most_cells=1e9)
    assert shown.stride == max(shape) // longest_px > 1
    assert max(shown.scan.shape) >= longest_px
    found = shown.picture(picture_of(shown.scan), longest_px).astype(float)
    whole = small_picture(picture_of(scan), longest_px).astype(float)
    assert found.shape == whole.shape
    error = np.abs(found - whole)[2:-2, 2:-2]
    assert np.median(error) <= 1.5
    moved = np.abs(found[:, 1:] - whole[:, :-1])[2:-2, 2:-2]
    assert np.median(moved) > 3 * np.median(error), "a texture that is one of its pixels off would be noticed"


def test_the_cells_are_bounded_and_codes_are_not_mixed() -> None:
    scan = scan_of(200, 300)
    shown = CoarseScan.of(scan, 300, most_cells=7000)
    assert shown.scan.ranges.size <= 7000
    codes = np.array(list(VISIBILITY), np.uint8)[:2]
    image = codes[np.indices(shown.scan.shape).sum(axis=0) % 2]
    found = shown.picture(image, 300, codes=True)
    assert found.shape == (200, 300, 3)
    assert {tuple(color) for color in found.reshape(-1, 3).tolist()} == {tuple(color) for color in codes.tolist()}


def test_a_scan_that_is_shown_whole_stays_itself() -> None:
    scan = scan_of(40, 60)
    shown = CoarseScan.of(scan, 300, most_cells=1e9)
    assert shown.scan is scan
    np.testing.assert_array_equal(shown.picture(picture_of(scan), 300), picture_of(scan))


def test_a_scan_with_a_single_return_is_not_thinned_away() -> None:
    ranges = np.full((40, 60), np.nan)
    ranges[0, 0] = ranges[1, 1] = 3.0
    scan = Scan(AzimuthElevation(40, 60, 0.01, 0.01), ranges, np.ones((40, 60)))
    assert CoarseScan.of(scan, 10, most_cells=1e9).scan is scan
