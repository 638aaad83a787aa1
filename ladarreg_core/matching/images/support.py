"""What a scan supports in comparison with a photo: its resolution, its intensity, and where nothing returned."""

from __future__ import annotations

from weakref import WeakKeyDictionary

import cv2
import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.foundations.arrays import BoolArray
from ladarreg_core.scan import Scan
from ladarreg_core.surface.perspective import native_focal_px

_COARSE = 0.6
_MIN_LEVELS, _MIN_SHARE = 6, 0.005
_SAMPLES = 20_000
_HOLE_CELLS = (3, 5)  # rows, columns: of an accumulated cloud, so many cells do not stay empty by chance
_BORDER_CELLS = 9
_MIN_OPEN_CELLS = 100  # smaller holes are gaps of the pattern of an accumulated cloud
_FINER = 1.4
_TINY_PIXELS = 8 * 32**2  # of a photo at the scan's resolution: refinement needs eight blocks, of 32 px a side
_INTERPOLATED = 2.5
# Variance factors of coarse scans, from simulated places outdoors. What the poses rest on is known to a cell, and
# displaced alike all over the image, which no comparison of its regions shows: outlines without intensity, and print
# with it. The wider the cells, as between the lines of a spinning lidar, the larger the common error.
_OUTLINES_VARIANCE, _OUTLINES_VARIANCE_PER_PX = 10.0, 4.5
_PRINT_VARIANCE, _PRINT_VARIANCE_PER_PX = 1.0, 1.5
_WIDE_CELL_PX = 1.25
_carries_intensity: WeakKeyDictionary[Scan, bool] = WeakKeyDictionary()  # a scan is read-only


def is_coarse(scan: Scan, camera: Camera) -> bool:
    """Return whether a scan is so much coarser than a photo that little but its depth edges can be compared.

    Args:
        scan: the scan.
        camera: the photo's camera.
    """
    return native_focal_px(scan) < _COARSE * camera.focal_px


def is_interpolated(scan: Scan, camera: Camera) -> bool:
    """Return whether a coarse scan is compared between its cells: at its own resolution the photo would be tiny.

    Args:
        scan: the scan.
        camera: the photo's camera.
    """
    shrink = native_focal_px(scan) / camera.focal_px
    return is_coarse(scan, camera) and camera.width * camera.height * shrink**2 < _TINY_PIXELS


def comparison_focal_px(scan: Scan, camera: Camera) -> float:
    """Return the focal length, px, that a scan supports in a comparison with a photo.

    It has one pixel per cell in the scan's finer direction. The outlines of a coarse scan of which only the shape is
    compared are known more finely than its cells, each of which has the mean ray of several returns. A scan that is
    interpolated has more pixels than cells: enough for a pose, not for a verdict by the number of regions.

    Args:
        scan: the scan.
        camera: the photo's camera.
    """
    native = native_focal_px(scan)
    if is_interpolated(scan, camera):
        return _INTERPOLATED * native
    return _FINER * native if is_coarse(scan, camera) and not carries_intensity(scan) else native


def widest_cell_px(scan: Scan, camera: Camera) -> float:
    """Return the width of a scan's cells in their wider direction, px of a view: the distance of its lines.

    Args:
        scan: the scan.
        camera: the view's camera.
    """
    return float(max(scan.geometry.step_rad) * camera.fx)


def common_variance(scan: Scan, camera: Camera, *, coarse: bool, shape_alone: bool) -> float:
    """Return the factor by which a variance from the scatter of image regions is too small; 1 for dense scans.

    Args:
        scan: the scan.
        camera: the view's camera.
        coarse: whether the scan is compared as a coarse one.
        shape_alone: whether only its shape is compared.
    """
    cell_px = widest_cell_px(scan, camera)
    if not coarse and cell_px <= _WIDE_CELL_PX:
        return 1.0
    if shape_alone:
        return max(_OUTLINES_VARIANCE, _OUTLINES_VARIANCE_PER_PX * cell_px)
    return _PRINT_VARIANCE + _PRINT_VARIANCE_PER_PX * cell_px


def carries_intensity(scan: Scan) -> bool:
    """Return whether a scan's intensity shows anything: it is not constant, and has more than a few levels."""
    if scan not in _carries_intensity:
        _carries_intensity[scan] = scan.has_intensity and not _has_few_levels(scan)
    return _carries_intensity[scan]


def _has_few_levels(scan: Scan) -> bool:
    """Return whether nearly all of a scan's intensity has a few values."""
    known = scan.intensity[scan.valid]
    _, count = np.unique(known[:: max(1, len(known) // _SAMPLES)], return_counts=True)
    common = count >= _MIN_SHARE * count.sum()
    return bool(np.count_nonzero(common) < _MIN_LEVELS and count[common].sum() > 0.9 * count.sum())


def open_cells(scan: Scan) -> BoolArray:
    """Return the cells (H, W) that were looked at and returned nothing: the sky, or what is too far or too dark.

    They are larger than gaps between beams and those of an accumulated cloud's pattern, and lie inside the region that
    the scanner looks at, the convex hull of the returns: what lies outside was not looked at, so that the border of
    that region is no edge of anything.
    """
    valid = scan.valid.astype(np.uint8)
    holes = cv2.morphologyEx(1 - valid, cv2.MORPH_OPEN, np.ones(_HOLE_CELLS, np.uint8))
    rows, columns = np.nonzero(valid)
    hull = cv2.convexHull(np.stack([columns, rows], axis=-1).astype(np.int32))
    inside = np.zeros_like(valid)
    cv2.fillConvexPoly(inside, hull, 1)
    # OpenCV takes what lies beyond the grid for inside: its first and last rows are no border of the hull.
    inside = np.asarray(cv2.erode(inside, np.ones((_BORDER_CELLS, _BORDER_CELLS), np.uint8)))
    _, label, figures, _ = cv2.connectedComponentsWithStats(((holes > 0) & (inside > 0)).astype(np.uint8))
    large = figures[:, cv2.CC_STAT_AREA] >= _MIN_OPEN_CELLS
    large[0] = False
    return np.asarray(large[label])
