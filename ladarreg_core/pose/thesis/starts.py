"""Where a simplex starts: the pose that is given, the linear one, or a guess that needs nothing."""

from __future__ import annotations

from typing import Literal

import numpy as np

from ladarreg_core.arrays import FloatArray
from ladarreg_core.errors import DegenerateGeometryError
from ladarreg_core.frames import Rigid, rotation_about, rotation_from_rotvec
from ladarreg_core.matches import Matches
from ladarreg_core.pose.thesis.epipolar import epipolar_residuals
from ladarreg_core.pose.thesis.linear import linear_pose
from ladarreg_core.pose.thesis.picture_roll import picture_roll
from ladarreg_core.pose.thesis.stereo import STEREO_AXES_FROM_SCANNER, StereoPairs

StartName = Literal["given", "linear", "aimed"]

_LEFT_OF_RANGE = 0.1
_CAMERA_FROM_STEREO_AXES = np.diag([-1.0, -1.0, 1.0])


def first_poses(matches: Matches, pairs: StereoPairs, initial: Rigid | None) -> list[tuple[StartName, FloatArray]]:
    """Return the parameters (6,) to start from, in the order to try them in.

    The one that is given comes first. Of the linear pose and the aimed one the better leads: mismatches can throw the
    linear pose anywhere, and near a plane there is none.

    Args:
        matches: M matches.
        pairs: the same.
        initial: a pose that is given, or none.
    """
    usable = pairs.subset(pairs.usable)
    found: list[tuple[StartName, FloatArray]] = [("aimed", aimed(usable))]
    try:
        pose = linear_pose(matches.points[pairs.usable], usable.colour.T)
        found.append(("linear", pairs.parameters(pose)))
    except DegenerateGeometryError:
        pass
    found.sort(key=lambda start: _typical(start[1], usable))
    if initial is not None:
        found.insert(0, ("given", pairs.parameters(initial)))
    return found


def aimed(pairs: StereoPairs) -> FloatArray:
    """Return the parameters (6,) of a camera a little to the left that looks at the middle of the matches.

    Its roll is the one that the matches show.

    Source: thesis 3.2 ('two meter translation'), scaled by the range.
    """
    if not len(pairs):
        return np.zeros(6)
    roll = picture_roll(pairs.laser, pairs.colour, pairs.depth) or 0.0
    rolled = rotation_about("z", roll) @ _towards(pairs.colour)
    aim = _towards(pairs.laser)
    axis = np.cross(rolled, aim)
    sine = float(np.linalg.norm(axis))
    turn = rotation_from_rotvec(axis / max(sine, 1e-300) * np.arctan2(sine, float(rolled @ aim)))
    Q = turn @ rotation_about("z", roll)
    from_frame = STEREO_AXES_FROM_SCANNER @ pairs.frame_from_scanner
    left = np.array([_LEFT_OF_RANGE * float(np.median(pairs.depth)), 0.0, 0.0])
    return pairs.parameters(Rigid.from_centre(_CAMERA_FROM_STEREO_AXES @ Q.T @ from_frame, from_frame.T @ left))


def _towards(coordinates: FloatArray) -> FloatArray:
    """Return the direction (3,) of the median coordinate, stereo axes."""
    middle = np.median(coordinates, axis=1)
    direction = np.array([-middle[0], -middle[1], 1.0])
    return np.asarray(direction / np.linalg.norm(direction))


def _typical(x: FloatArray, pairs: StereoPairs) -> float:
    error = np.linalg.norm(epipolar_residuals(x, pairs), axis=0)
    return float(np.median(np.where(np.isfinite(error), error, np.inf)))
