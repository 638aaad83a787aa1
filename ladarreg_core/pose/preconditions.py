"""Preconditions of a pose estimate, checked before any solver runs; each violation is explained in one line."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from ladarreg_core.camera import CameraModel, require_camera
from ladarreg_core.errors import DegenerateGeometryError, OptionError, ShapeError
from ladarreg_core.frames import Rigid, principal_extents
from ladarreg_core.matches import Matches
from ladarreg_core.pose.acceptance import count_distinct

MIN_MATCHES = 4
_UNIT_TOLERANCE = 1e-3
_COLLINEAR = 1e-3  # middle over largest extent: below it the points are collinear
_MAX_RANGE_M, _MAX_PIXEL = 1e7, 1e7
_MIN_WEIGHT, _MAX_WEIGHT = 1e-9, 1e9  # the points of a line share its weight


def check_matches(matches: Matches, camera: CameraModel, initial: Rigid | None) -> Matches:
    """Return the matches with rays of length 1, or raise an error that explains what is wrong with them.

    Args:
        matches: M matches.
        camera: the photo's camera.
        initial: an initial pose, or none.

    Raises:
        LadarregError: as `estimate_pose`.
    """
    require_camera(camera, "the camera")
    if initial is not None and not isinstance(initial, Rigid):
        raise OptionError(f"the initial pose is a {type(initial).__name__}; give a Rigid (camera_from_scanner)")
    if initial is not None and not np.abs(initial.centre).max() <= _MAX_RANGE_M:
        raise OptionError(f"the initial pose is more than {_MAX_RANGE_M:g} m from the scanner; check its unit")
    count = len(matches)
    if count < MIN_MATCHES:
        raise DegenerateGeometryError(f"{_count_phrase(matches)} and a pose needs {MIN_MATCHES}; add matches")
    numbers = [matches.rays, matches.ranges, matches.uv, matches.weights, matches.range_weights, matches.directions]
    if not all(np.isfinite(each).all() for each in numbers):
        finite = np.isfinite(np.column_stack(numbers)).all(axis=1)
        raise ShapeError(f"{_subject(~finite, matches)} NaN or infinity; remove them, or give each a range and a pixel")
    both = np.stack([matches.weights, matches.weights * matches.range_weights])
    if not (both.min() >= _MIN_WEIGHT and both.max() <= _MAX_WEIGHT):
        bad = ~((both >= _MIN_WEIGHT) & (both <= _MAX_WEIGHT)).all(axis=0)
        raise ShapeError(f"{_subject(bad, matches)} a weight outside {_MIN_WEIGHT:g} to {_MAX_WEIGHT:g}; remove them")
    ranges, uv = matches.ranges, matches.uv
    if not (ranges.min() > 0 and ranges.max() <= _MAX_RANGE_M and np.abs(uv).max() <= _MAX_PIXEL):
        good = (ranges > 0) & (ranges <= _MAX_RANGE_M) & (np.abs(uv) <= _MAX_PIXEL).all(axis=1)
        raise ShapeError(
            f"{_subject(~good, matches)} a range that is not positive, or a range or pixel beyond "
            f"{_MAX_RANGE_M:g}; ranges are metres along the ray"
        )
    if matches.across.any():
        along = np.abs(np.linalg.norm(matches.directions, axis=1) - 1) <= _UNIT_TOLERANCE
        undirected = matches.across & ~along
        if undirected.any():
            raise ShapeError(f"{_subject(undirected, matches)} no line direction; give it as a unit vector")
    length = np.linalg.norm(matches.rays, axis=1)
    off_unit = np.abs(length - 1)
    if off_unit.max() > _UNIT_TOLERANCE:
        raise ShapeError(
            f"{_subject(off_unit > _UNIT_TOLERANCE, matches)} a ray whose length is not 1; normalise the rays"
        )
    different = count_distinct(matches.points, matches.uv)
    if different < MIN_MATCHES:
        raise DegenerateGeometryError(
            f"only {different} of the {count} matches are distinct and a pose needs {MIN_MATCHES}; add matches"
        )
    extent = principal_extents(matches.points)
    if extent[1] <= _COLLINEAR * extent[0]:
        raise DegenerateGeometryError("the scan points of the matches are collinear; add matches off that line")
    if off_unit.max() < 1e-14:
        return matches
    return replace(matches, rays=matches.rays / length[:, None])


def _count_phrase(matches: Matches) -> str:
    """Return the number of matches as a clause; if lines give several matches each, the number of picks as well."""
    count, drawn = len(matches), len(set(matches.pick_ids))
    if drawn == count:
        return f"there are {count} matches"
    return f"{drawn} drawn {'line gives' if drawn == 1 else 'lines and points give'} {count} matches"


def _subject(bad: ArrayLike, matches: Matches) -> str:
    ids = [matches.pick_ids[k] for k in np.flatnonzero(bad)[:3]]
    count = int(np.count_nonzero(bad))
    return f"{count} of {len(matches)} matches ({', '.join(ids)}{', ...' if count > 3 else ''}) have"
