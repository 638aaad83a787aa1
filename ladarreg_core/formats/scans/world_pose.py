"""The scanner's pose in the world, as the files of scans state it, checked."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ladarreg_core.errors import DegenerateGeometryError, FormatError, ShapeError
from ladarreg_core.frames import Rigid

LARGEST_COORDINATE_M = 1e9
"""The largest coordinate of a scanner that is taken for metres."""


def world_pose(matrix: ArrayLike, what: str) -> Rigid:
    """Return a pose `world_from_scanner` that a file states.

    Args:
        matrix: (4, 4), any numeric type.
        what: how the file calls it, for errors.

    Raises:
        FormatError: if it is not a rotation and a translation (to 1e-3; rounding is removed), or a coordinate is beyond
            1e9 m, where double precision ends at a tenth of a micrometre.
    """
    try:
        pose = Rigid.from_matrix(np.asarray(matrix, dtype=np.float64))
    except (DegenerateGeometryError, ShapeError) as error:
        raise FormatError(
            f"{what} is not a rigid transformation: {error}; it must be a rotation and a translation in metres, "
            "without scale"
        ) from None
    if np.abs(pose.translation).max() > LARGEST_COORDINATE_M:
        raise FormatError(
            f"{what} has the coordinate {np.abs(pose.translation).max():.3g} m; at most {LARGEST_COORDINATE_M:g} m is "
            "read: check its unit"
        )
    return pose
