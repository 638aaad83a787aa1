"""The flow step: regions that agree better a little way off pull the pose there, by RANSAC over all of them."""

from __future__ import annotations

import numpy as np

from ladarreg_core.frames import Rigid
from ladarreg_core.matching.agreement import Agreement
from ladarreg_core.matching.blocks import Target
from ladarreg_core.matching.sampling import ViewPoints
from ladarreg_core.pose.ransac import ransac_pose

_LEAST_HEIGHT_SD = 2.2
_POINTS_A_WINDOW = 3
_RANSAC_PX = 1.5
_RANSAC_ITERATIONS = 200
_LEAST_MATCHES, _LEAST_INLIERS = 24, 18


def flow_step(points: ViewPoints, target: Target, maps: Agreement, *, seed: int) -> Rigid | None:
    """Return the pose that most windows' peaks agree on, or None where they agree on none.

    Args:
        points: the level's scan points.
        target: the photo at that level.
        maps: agreement of that level at the present pose.
        seed: of RANSAC.
    """
    if not maps.windows:
        return None
    shift, height, border = maps.peaks()
    index, uv = [], []
    for k in np.flatnonzero((height >= _LEAST_HEIGHT_SD) & ~border):
        members = maps.members[k]
        chosen = members[np.linspace(0, len(members) - 1, _POINTS_A_WINDOW).astype(np.intp)]
        index.append(chosen)
        uv.append(maps.uv[chosen] + shift[k])
    if _POINTS_A_WINDOW * len(index) < _LEAST_MATCHES:
        return None
    result = ransac_pose(
        points.points[np.concatenate(index)].astype(np.float64),
        np.concatenate(uv).astype(np.float64),
        target.camera,
        threshold_px=_RANSAC_PX,
        iterations=_RANSAC_ITERATIONS,
        seed=seed,
    )
    if result is None or np.count_nonzero(result.inliers) < _LEAST_INLIERS:
        return None
    return result.camera_from_scanner
