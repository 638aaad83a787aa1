"""Starting poses of a simplex: the given pose, the linear pose, or a camera aimed at the matches."""

from __future__ import annotations

from typing import Literal

import numpy as np

from ladarreg_core.errors import DegenerateGeometryError
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.frames import Rigid, rotation_about, rotation_from_rotvec
from ladarreg_core.matches import Matches
from ladarreg_core.thesis.estimators.epipolar import epipolar_residuals
from ladarreg_core.thesis.estimators.linear import linear_pose
from ladarreg_core.thesis.estimators.stereo import STEREO_AXES_FROM_SCANNER, StereoPairs

StartName = Literal["given", "linear", "aimed"]

_LEFT_OF_RANGE = 0.1
_CAMERA_FROM_STEREO_AXES = np.diag([-1.0, -1.0, 1.0])
_MIN_MATCHES = 5
_MAX_PARTNERS = 60
_SMOOTHING_DEG = 6.0
_NEAR_DEG = 20.0
_LEVEL = 0.02
_BEST_SHARE = 0.2
_MIN_MODE_SHARE = 0.25  # of the pairs within 20 degrees of the mode; 0.11 by chance


def starting_poses(matches: Matches, pairs: StereoPairs, initial: Rigid | None) -> list[tuple[StartName, FloatArray]]:
    """Return the parameters (6,) of the starting poses, in the order in which to try them.

    The given pose comes first, then the better of the linear and the aimed pose: outliers can make the linear pose
    useless, and near a plane it does not exist.

    Args:
        matches: M matches.
        pairs: the same matches.
        initial: the given pose, or None.
    """
    usable = pairs.subset(pairs.usable)
    found: list[tuple[StartName, FloatArray]] = [("aimed", aimed_start(usable))]
    try:
        pose = linear_pose(matches.points[pairs.usable], usable.color.T)
        found.append(("linear", pairs.parameters(pose)))
    except DegenerateGeometryError:
        pass
    found.sort(key=lambda start: _median_residual(start[1], usable))
    if initial is not None:
        found.insert(0, ("given", pairs.parameters(initial)))
    return found


def aimed_start(pairs: StereoPairs) -> FloatArray:
    """Return the parameters (6,) of a camera slightly to the left, aimed at the median of the matches.

    Its roll is estimated from the matches.

    Source: thesis 3.2 ('two meter translation'), scaled by the range.
    """
    if not len(pairs):
        return np.zeros(6)
    roll = picture_roll(pairs.laser, pairs.color, pairs.depth) or 0.0
    rolled = rotation_about("z", roll) @ _towards(pairs.color)
    aim = _towards(pairs.laser)
    axis = np.cross(rolled, aim)
    sine = float(np.linalg.norm(axis))
    turn = rotation_from_rotvec(axis / max(sine, 1e-300) * np.arctan2(sine, float(rolled @ aim)))
    Q = turn @ rotation_about("z", roll)
    from_frame = STEREO_AXES_FROM_SCANNER @ pairs.frame_from_scanner
    left = np.array([_LEFT_OF_RANGE * float(np.median(pairs.depth)), 0.0, 0.0])
    return pairs.parameters(Rigid.from_centre(_CAMERA_FROM_STEREO_AXES @ Q.T @ from_frame, from_frame.T @ left))


def picture_roll(laser: FloatArray, color: FloatArray, depth: FloatArray) -> float | None:
    """Return gamma, the roll of the colour camera about its optical axis, rad; None if the matches do not show it.

    The direction from one match to another rotates by the roll, regardless of shift and scale between the two images.
    Outliers spread it evenly, and parallax perturbs it little between points of similar depth, so that the mode over
    many pairs is robust to both.

    Args:
        laser: (2, N) coordinates in the scan image.
        colour: (2, N) coordinates in the photo, with axes in the same directions.
        depth: (N,) of the scan points, m.
    """
    count = laser.shape[1]
    if count < _MIN_MATCHES:
        return None
    shifts = np.unique(np.linspace(1, count - 1, min(count - 1, _MAX_PARTNERS)).astype(np.intp))
    first = np.tile(np.arange(count), len(shifts))
    second = (first + np.repeat(shifts, count)) % count
    l, c = (xy[0] + 1j * xy[1] for xy in (laser, color))  # noqa: E741 - laser and colour, as complex numbers
    from_laser, from_color = l[second] - l[first], c[second] - c[first]
    # noise rotates short directions most, parallax those between different depths
    length = np.minimum(np.abs(from_laser), np.abs(from_color))
    long = (length > 0) & (length >= np.median(length))
    inverse = 1 / depth
    quality = np.where(long, length / (np.abs(inverse[second] - inverse[first]) + _LEVEL * np.median(inverse)), 0.0)
    long &= quality >= np.quantile(quality, 1 - _BEST_SHARE)
    if not long.any():
        return None
    rotation = np.angle(from_laser[long] * np.conj(from_color[long]))
    frequency = np.bincount(np.floor(np.degrees(rotation)).astype(np.intp) % 360, minlength=360).astype(np.float64)
    offset = np.minimum(np.arange(360), 360 - np.arange(360))
    kernel = np.exp(-0.5 * (offset / _SMOOTHING_DEG) ** 2)
    smooth = np.fft.irfft(np.fft.rfft(frequency) * np.fft.rfft(kernel), 360)
    mode = np.deg2rad(float(np.argmax(smooth)) + 0.5)
    off = np.angle(np.exp(1j * (rotation - mode)))
    near = np.abs(off) <= np.deg2rad(_NEAR_DEG)
    if near.mean() < _MIN_MODE_SHARE:
        return None
    return float(np.angle(np.exp(1j * (mode + np.median(off[near])))))


def _towards(coordinates: FloatArray) -> FloatArray:
    """Return the direction (3,) of the median coordinate, stereo axes."""
    middle = np.median(coordinates, axis=1)
    direction = np.array([-middle[0], -middle[1], 1.0])
    return np.asarray(direction / np.linalg.norm(direction))


def _median_residual(x: FloatArray, pairs: StereoPairs) -> float:
    error = np.linalg.norm(epipolar_residuals(x, pairs), axis=0)
    return float(np.median(np.where(np.isfinite(error), error, np.inf)))
