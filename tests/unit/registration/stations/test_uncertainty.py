"""The covariance of stations states the errors that they have, also where few surfaces hold a direction."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from ladarreg_core.acquisition.alignment.adjustment import RangeView
from ladarreg_core.frames import Rigid, rotvec_from_rotation
from ladarreg_core.registration.stations.uncertainty import polish

SIZE = np.array([4.0, 3.0, 2.5])
SECOND = Rigid.from_rotvec([0.01, -0.02, 0.6], [0.9, 0.4, 0.1])


def walls(rng: np.random.Generator, faces: int, together_m: float) -> NDArray[np.float64]:
    """Return points (N, 3) on the faces of a room as one station measures them.

    Args:
        rng: of the noise.
        faces: the first of the six faces: 2 for each of X, Y, Z.
        together_m: error that all points of a square half a metre wide share, 1 sigma.
    """
    found = []
    for face in range(faces):
        axis, side = divmod(face, 2)
        points = rng.uniform(-0.5, 0.5, (1500, 3)) * SIZE
        points[:, axis] = (side - 0.5) * SIZE[axis]
        square = np.floor(2 * points).astype(np.int64) @ np.array([1, 100, 10_000])
        _, square = np.unique(square, return_inverse=True)
        shared = rng.normal(0, together_m, square.max() + 1)[square]
        points[:, axis] += shared + rng.normal(0, 0.003, len(points))
        found.append(points)
    return np.concatenate(found)


@pytest.mark.parametrize("together_m", [0.0, 0.0005])
@pytest.mark.long
def test_errors_are_as_large_as_stated(together_m: float) -> None:
    distances = []
    for seed in range(30):
        rng = np.random.default_rng([seed, int(1e6 * together_m)])
        first, second = walls(rng, 6, together_m), SECOND.inverse @ walls(rng, 6, together_m)
        views = [RangeView(points, Rigid.identity(), np.zeros((6, 6))) for points in (first, second)]
        found = polish(views, [Rigid.identity(), SECOND], fixed=0)
        turn = SECOND.rotation @ found.poses[1].rotation.T
        error = np.concatenate([rotvec_from_rotation(turn), SECOND.translation - turn @ found.poses[1].translation])
        distances.append(float(error @ np.linalg.solve(found.covariance[6:, 6:], error) / 6))
        assert not found.covariance[:6].any()
    # 180 degrees of freedom: an honest covariance misses this by chance once in five hundred times.
    assert 0.84 <= np.sqrt(np.mean(distances)) <= 1.17


def test_what_no_surface_holds_has_no_finite_precision() -> None:
    rng = np.random.default_rng(5)
    views = [
        RangeView(pose.inverse @ walls(rng, 4, 0.0), pose, np.zeros((6, 6))) for pose in (Rigid.identity(), SECOND)
    ]
    found = polish(views, [Rigid.identity(), SECOND], fixed=0)
    sigma = np.sqrt(np.diag(found.covariance)[9:])
    assert sigma[2] > 0.01  # neither floor nor ceiling: the noise of the walls pretends to a little, and no more
    assert sigma[:2].max() < 0.001
