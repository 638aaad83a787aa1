"""How level scans stand, as an inclinometer says, as observations of a network of targets.

A scan that is stated as level has its Z axis up, but for a small turn w about its axes: true = exp([w]x) stated, with a
covariance. All scans have one up, that of the coordinates if the world is theirs, else an unknown of two angles.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.errors import OptionError
from ladarreg_core.foundations.arrays import read_only
from ladarreg_core.foundations.validation import require_number
from ladarreg_core.frames import Rigid, skew

Array = NDArray[np.float64]
_UP = np.array([0.0, 0.0, 1.0])
_MIN_DEG, _MAX_DEG = 1e-5, 10.0  # beyond which it is a mistake


@dataclass(frozen=True, slots=True, eq=False)
class Levels:
    """What is known of the levels of bodies."""

    roots: Mapping[int, Array]
    """(2, 2) square root of the information of w about X and Y, by the index of the body."""
    is_known: bool
    """Whether the Z axis of the root is up; else its up is an unknown."""

    def without(self, body: int) -> Levels:
        """Return the same without a body."""
        return Levels({k: root for k, root in self.roots.items() if k != body}, self.is_known)

    def rows(
        self, poses: Sequence[Rigid], up: Array, columns: Mapping[int, int], size: int, of_up: int
    ) -> tuple[Array, Array]:
        """Return the derivatives (L, 2, P) and the residuals (L, 2) in standard deviations.

        Args:
            poses: `root_from_body`.
            up: (3,) in the frame of the root.
            columns: where the (w, c) of each free body begin among the unknowns.
            size: P, the number of unknowns.
            of_up: where the two of `up` begin, if it is not known.
        """
        jacobian, off = np.zeros((len(self.roots), 2, size)), np.zeros((len(self.roots), 2))
        for n, (k, root) in enumerate(self.roots.items()):
            back = poses[k].rotation.T
            seen = back @ up
            # Up is z + w x z = (w_y, -w_x, 1) in the frame of the scan.
            take = root @ np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])
            off[n] = take @ seen
            if k in columns:
                jacobian[n, :, columns[k] : columns[k] + 3] = take @ back @ skew(up)
            if not self.is_known:
                jacobian[n, :, of_up : of_up + 2] = take @ back @ tangents(up)
        return jacobian, off

    def first_up(self, poses: Sequence[Rigid]) -> Array:
        """Return the up that the bodies agree on, (3,) in the frame of the root."""
        if self.is_known or not self.roots:
            return _UP
        mean = np.sum([poses[k].rotation @ _UP for k in self.roots], axis=0)
        return np.asarray(mean / np.linalg.norm(mean))


NO_LEVELS = Levels({}, True)


def tangents(up: Array) -> Array:
    """Return two unit vectors across one, as columns (3, 2)."""
    across = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    across /= np.linalg.norm(across)
    return np.column_stack([across, np.cross(up, across)])


def information_root(name: str, value: float | ArrayLike) -> Array:
    """Return the square root of the information of a level, (2, 2).

    Args:
        name: of the scan, for messages.
        value: standard deviation about each of its horizontal axes, deg; or the covariance (3, 3) of w, rad^2, as
            `level_covariance` of `panorama.json` has it.

    Raises:
        OptionError: if it is neither.
        ShapeError: if a covariance has another shape.
    """
    if isinstance(value, int | float):
        require_number(value, f"the level of scan {name}, deg", least=_MIN_DEG, most=_MAX_DEG)
        covariance = np.radians(value) ** 2 * np.eye(2)
    else:
        covariance = read_only(value, np.float64, (3, 3), f"the level of scan {name}")[:2, :2]
    values = np.linalg.eigvalsh(covariance) if np.isfinite(covariance).all() else np.zeros(1)
    if values.min() < (0.99 * np.radians(_MIN_DEG)) ** 2:
        raise OptionError(
            f"the covariance of the level of scan {name} is none of a level; give that of a panorama whose plan states "
            "'base_sigma_deg', or a standard deviation in degrees"
        )
    return np.asarray(np.linalg.cholesky(np.linalg.inv(covariance)).T)
