"""A pose that was written in another convention: inverted, with other camera axes, or with another order of quaternion.

Such a pose is rigid and valid, and only looks elsewhere or is upside down. What the camera would see, and which way up
it would hold the picture, distinguish it from a correct one.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ladarreg_core.camera import CameraModel
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid
from ladarreg_core.scan import Scan

_SAMPLES = 4000
_FIELDS = (12, 8)  # of the picture, for the share of it in which the scan is seen
_DOUBTFUL_SHARE, _DOUBTFUL_ROLL_DEG = 0.2, 60.0
_LIKELY_SHARE, _LIKELY_ROLL_DEG = 0.5, 30.0
_ALIKE_SHARE, _MAX_NAMED = 0.1, 2  # a camera that hardly turns is nearly its own inverse
_OPENGL_AXES = Rigid(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
_BODY_AXES = Rigid(CAMERA_AXES_FROM_SCANNER, np.zeros(3))


@dataclass(frozen=True, slots=True)
class _Look:
    """What a camera would show."""

    share: float
    """Of the picture, with points of the scan."""
    roll_deg: float
    """From upright, 0 to 180."""


def other_convention(scan: Scan, camera: CameraModel, pose: Rigid) -> str | None:
    """Return the convention in which a pose was probably written, as a sentence; None where the pose is plausible.

    Args:
        scan: the scan, whose Z is up.
        camera: the camera of the photograph, which is taken to be upright.
        pose: what was given as `camera_from_scanner`.
    """
    points = scan.points[scan.valid]
    points = points[:: max(1, len(points) // _SAMPLES)].astype(np.float64)
    look = _look(points, camera, pose)
    if look.share >= _DOUBTFUL_SHARE and look.roll_deg <= _DOUBTFUL_ROLL_DEG:
        return None
    found = [(_look(points, camera, other), words) for other, words in _readings(pose)]
    likely = [one for one in found if one[0].share >= _LIKELY_SHARE and one[0].roll_deg <= _LIKELY_ROLL_DEG]
    if not likely:
        return None
    best = max(look.share for look, _ in likely)
    words = " or as ".join([words for look, words in likely if look.share >= best - _ALIKE_SHARE][:_MAX_NAMED])
    wrong = (
        f"shows the scan in {100 * look.share:.0f} % of its picture"
        if look.share < _DOUBTFUL_SHARE
        else f"is turned by {look.roll_deg:.0f} deg from upright"
    )
    return (
        f"At the pose that was given the camera {wrong}. Read as {words}, the same numbers show the scan in "
        f"{100 * best:.0f} % of an upright picture; give camera_from_scanner, with x right, y down, z forward."
    )


def _readings(pose: Rigid) -> Iterator[tuple[Rigid, str]]:
    """Yield the pose as other conventions would have written it, the usual ones first."""
    yield pose.inverse, "scanner_from_camera, the inverse"
    yield _OPENGL_AXES @ pose, "a pose of OpenGL's axes (y up, looking along -z)"
    yield _OPENGL_AXES @ pose.inverse, "the inverse, with OpenGL's axes (y up, looking along -z)"
    yield _BODY_AXES @ pose, "a pose of a robot's axes (x forward, y left, z up)"
    yield _BODY_AXES @ pose.inverse, "the inverse, with a robot's axes (x forward, y left, z up)"
    q = pose.quaternion_wxyz
    yield Rigid.from_quaternion_wxyz(np.roll(q, 1), pose.translation), "a quaternion in the order x y z w"
    yield Rigid.from_quaternion_wxyz(np.roll(q, -1), pose.translation), "a quaternion in the order w x y z"


def _look(points: np.ndarray, camera: CameraModel, pose: Rigid) -> _Look:
    """Return what a camera at a pose shows of points (N, 3), in the scanner frame, m."""
    with np.errstate(all="ignore"):
        uv = camera.project(pose @ points)
    inside = camera.contains(uv)
    cells = np.floor(uv[inside] / camera.size * _FIELDS).astype(int).clip(0, np.array(_FIELDS) - 1)
    seen = np.zeros(_FIELDS, bool)
    seen[tuple(cells.T)] = True
    down, right = pose.rotation[1, 2], pose.rotation[0, 2]  # the scanner's Z in the camera's axes
    return _Look(float(seen.mean()), float(np.degrees(np.arctan2(abs(right), -down))))
