"""What each compared block of a finished automatic registration says: its own step, and how much that one counts."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ladarreg_core.foundations.arrays import FloatArray, IntArray
from ladarreg_core.matching.images.blocks import BlockComparison, block_names, centre_points
from ladarreg_core.matching.images.sampling import ViewPoints
from ladarreg_core.matching.refine.ecc import RefineOptions, block_weights
from ladarreg_core.results.compared_blocks import ComparedBlocks

_MEDIAN_CHI2 = 2 * float(np.log(2))  # of two degrees of freedom
_ALONG_AN_EDGE = 1e-3  # of a block's trace: keeps its own step short where it does not constrain it
_MIN_RHO = 0.05
_MIN_VARIANCE = 1e-12
_STEP_PX = 0.5
_A_JUMP, _SINGULAR = 100.0, 1e-6


def compared_blocks(
    seen: BlockComparison,
    points: ViewPoints,
    in_photo: Callable[[FloatArray], FloatArray],
    agreeing: IntArray,
    options: RefineOptions,
) -> ComparedBlocks:
    """Return the compared blocks of a finished pose, in the photo's own pixels.

    A block contributes w rho G to the normal equations of the refinement and w r to their right-hand side, with its
    weight w, its correlation rho, and the sums G of products of its gradient. Its own step is (rho G)^-1 r. The scatter
    of the steps of the blocks that agree gives the unit of the information: the median of d^T (w rho G) d, over that of
    chi^2 with two degrees of freedom.

    Args:
        seen: the b blocks at the pose.
        points: the points that were compared.
        in_photo: the photo's own pixels (b, 2) at pixels (b, 2) of the comparison. Blocks where they are unknown, or
            jump, as at the seam of a panorama, are left out.
        agreeing: indices of the blocks that agree: those of the inliers of the matches.
        options: those of the refinement that ended at the pose.
    """
    uu, uv, vv, right_u, right_v = (np.asarray(value, np.float64) for value in seen.normal_equations)
    rho = np.maximum(seen.rho.astype(np.float64), _MIN_RHO)
    curvature = rho[:, None, None] * np.stack([uu, uv, uv, vv], axis=-1).reshape(-1, 2, 2)
    trace = np.maximum(curvature[:, 0, 0] + curvature[:, 1, 1], np.finfo(np.float32).tiny)
    eased = curvature + _ALONG_AN_EDGE * trace[:, None, None] * np.eye(2)
    step = np.linalg.solve(eased, np.stack([right_u, right_v], axis=-1)[..., None])[..., 0]
    information = block_weights(seen, options.tau_px).astype(np.float64)[:, None, None] * curvature

    agrees = np.zeros(len(step), np.bool_)
    agrees[agreeing] = True
    squared = np.einsum("bi,bij,bj->b", step, information, step)
    used = squared[agrees] if agrees.any() else squared
    information = information / max(float(np.median(used)) / _MEDIAN_CHI2, _MIN_VARIANCE)

    at = seen.uv[centre_points(seen)].astype(np.float64)
    own, (u, v) = in_photo(at), _STEP_PX * np.eye(2)
    by_u, by_v = (in_photo(at + step) - in_photo(at - step) for step in (u, v))
    by_pixel = np.stack([by_u, by_v], axis=-1) / (2 * _STEP_PX)
    with np.errstate(invalid="ignore"):
        known = np.isfinite(own).all(axis=-1) & (np.abs(by_pixel) < _A_JUMP).all(axis=(1, 2))
        known &= np.abs(by_pixel[:, 0, 0] * by_pixel[:, 1, 1] - by_pixel[:, 0, 1] * by_pixel[:, 1, 0]) > _SINGULAR
    kept = np.flatnonzero(known)
    by_pixel, back, names = by_pixel[kept], np.linalg.inv(by_pixel[kept]), block_names(seen, points)
    return ComparedBlocks(
        ids=tuple(names[k] for k in kept.tolist()),
        uv=own[kept],
        offset_px=np.einsum("bij,bj->bi", by_pixel, step[kept]),
        information=np.einsum("bki,bkl,blj->bij", back, information[kept], back),
        correlation=seen.rho[kept],
        agrees=agrees[kept],
    )
