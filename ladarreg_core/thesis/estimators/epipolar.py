"""The stereo geometry as a residual without poles: distance of a colour pixel from its prediction by laser depth.

Eq 2.19 solved for the disparity instead of the depth; both are equivalent for e = 0. With a small baseline this
residual becomes small but stays well defined, and the rotation to equal baselines, under which a sum of squares is
invariant, is not needed.

Source: thesis Eq 2.13, 2.17-2.18.
"""

from __future__ import annotations

from collections.abc import Callable
from math import cos, sin
from struct import Struct

import numpy as np

from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.thesis.estimators.stereo import POLE, StereoPairs, rectify

_EPIPOLAR_ROWS = Struct("9d 32x 6d 24x 3d 8x 3d 72x d 3d 72x d")  # doubles, separated by zero bytes


def epipolar_residuals(x: FloatArray, pairs: StereoPairs) -> FloatArray:
    """Return e_x = (x'c - xl) - (Tx + Tz x'c) / Zl and e_y likewise, with lambda = 1.

    Args:
        x: (6,) Tx, Ty, Tz (m), alpha, beta, gamma (rad).
        pairs: M matches.

    Returns:
        (2, M), tangents in the rectified image; multiply by the focal length for pixels.
    """
    Tx, Ty, Tz, alpha, beta, gamma = map(float, x)
    with np.errstate(divide="ignore", invalid="ignore"):
        rectified = np.stack(rectify(pairs.color[0], pairs.color[1], alpha=alpha, beta=beta, gamma=gamma))
        shift = np.array([[Tx], [Ty]])
        return np.asarray((rectified - pairs.laser) - (shift + Tz * rectified) / pairs.depth)


def epipolar_cost(pairs: StereoPairs) -> Callable[[FloatArray], float]:
    """Return the weighted sum of squares of `epipolar_residuals` as a function of the pose.

    As in `stereo_cost`, the residuals multiplied by v_z are linear in terms that do not depend on the pose: w, w / Zl,
    xl w and yl w.

    Args:
        pairs: M matches, all usable.

    Returns:
        A function of x = (Tx, Ty, Tz, alpha, beta, gamma) in m and rad. It reuses its buffers and is not thread-safe.
    """
    count = len(pairs)
    sight = np.vstack([-pairs.color, np.ones(count)])
    terms = np.vstack([sight, sight / pairs.depth, pairs.laser[0] * sight, pairs.laser[1] * sight, np.ones(count)])
    coefficients, sums, values = np.zeros((4, 13)), np.empty((4, count)), np.empty(2 * count)
    numerators, denominators = sums[:2].reshape(-1), sums[2:].reshape(-1)
    root_weights, weighted = np.tile(np.sqrt(pairs.weights), 2), bool((pairs.weights != 1).any())
    pack, buffer, product, squares = _EPIPOLAR_ROWS.pack_into, coefficients.data, coefficients.dot, values.dot
    divide, multiply = np.divide, np.multiply

    def cost(x: FloatArray) -> float:
        Tx, Ty, Tz, alpha, beta, gamma = x.tolist()
        sin_a, cos_a, sin_b, cos_b, sin_g, cos_g = sin(alpha), cos(alpha), sin(beta), cos(beta), sin(gamma), cos(gamma)
        # x'c v_z, y'c v_z and v_z, as sums over w
        x0, x1, x2 = sin_a * sin_b * sin_g - cos_a * cos_g, cos_a * sin_g + sin_a * sin_b * cos_g, sin_a * cos_b
        y0, y1, y2 = -cos_b * sin_g, -cos_b * cos_g, sin_b
        z0, z1, z2 = cos_a * sin_b * sin_g + sin_a * cos_g, cos_a * sin_b * cos_g - sin_a * sin_g, cos_a * cos_b
        pack(
            buffer, 0,
            x0, x1, x2, -Tz * x0 - Tx * z0, -Tz * x1 - Tx * z1, -Tz * x2 - Tx * z2, -z0, -z1, -z2,
            y0, y1, y2, -Tz * y0 - Ty * z0, -Tz * y1 - Ty * z1, -Tz * y2 - Ty * z2, -z0, -z1, -z2,
            z0, z1, z2, POLE,
            z0, z1, z2, POLE,
        )  # fmt: skip
        product(terms, sums)
        divide(numerators, denominators, values)
        if weighted:
            multiply(values, root_weights, values)
        return float(squares(values))

    return cost
