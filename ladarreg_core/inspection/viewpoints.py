"""Viewpoints of the 3-D scene: at the scanner, at the camera, and an overview."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ladarreg_core.camera import CameraModel, axial_pinhole
from ladarreg_core.foundations.arrays import FloatArray, read_only
from ladarreg_core.frames import Rigid, look_along, rotation_from_rotvec
from ladarreg_core.scan import Scan

_OVERVIEW_FOV_RAD = (float(np.deg2rad(58.0)), float(np.deg2rad(47.0)))
_INSIDE_FOV_RAD = (float(np.deg2rad(80.0)), float(np.deg2rad(60.0)))
_NARROWEST_RAD, _WIDEST_RAD = 0.02, 2.6
_MEAN_OF_HALF_A_CIRCLE = 2 / np.pi
_ASIDE, _ABOVE, _ROOM, _FILLED = 0.25, 0.3, 0.2, 0.92
_HALVINGS = 30
_SAMPLES, _PERCENTILES = 4000, (1.0, 99.0)


@dataclass(frozen=True, slots=True, eq=False)
class Viewpoint:
    """Position and viewing direction of the scene camera; read-only."""

    position: FloatArray
    """(3,) m, scanner frame."""
    look_at: FloatArray
    """(3,) m, different from the position."""
    up: FloatArray
    """(3,)."""
    fov_rad: tuple[float, float]
    """Field of view to be shown, horizontal and vertical."""

    def __post_init__(self) -> None:
        for name in ("position", "look_at", "up"):
            object.__setattr__(self, name, read_only(getattr(self, name), np.float64, (3,), name.replace("_", " ")))

    def upright_fov_rad(self, aspect: float) -> float:
        """Return the vertical field of view with which a window shows the whole field of view.

        Args:
            aspect: width over height of the window.
        """
        across, upright = (np.tan(angle / 2) for angle in self.fov_rad)
        needed = 2 * np.arctan(max(float(upright), float(across) / max(aspect, 1e-3)))
        return float(np.clip(needed, _NARROWEST_RAD, _WIDEST_RAD))


def typical_range(scan: Scan) -> float:
    """Return the median range of a scan's returns, m."""
    return float(np.median(scan.ranges[scan.valid]))


def field_of_view(camera: CameraModel) -> tuple[float, float]:
    """Return the horizontal and vertical field of view of a camera, rad, taking its axis as central.

    Of a wide camera it is that of a view along its axis.
    """
    pinhole = axial_pinhole(camera)
    return (
        2 * float(np.arctan2(pinhole.width, 2 * pinhole.fx)),
        2 * float(np.arctan2(pinhole.height, 2 * pinhole.fy)),
    )


def from_pose(scan: Scan, camera: CameraModel, camera_from_scanner: Rigid) -> Viewpoint:
    """Return the viewpoint of a camera."""
    _, down, forward = camera_from_scanner.rotation
    centre = camera_from_scanner.centre
    return Viewpoint(centre, centre + forward * typical_range(scan), -down, field_of_view(camera))


def is_all_around(scan: Scan) -> bool:
    """Return whether a scan covers half of the horizon or more, so that its content lies around the scanner."""
    level = scan.sampled_directions[:, :2].astype(np.float64)
    level /= np.maximum(np.linalg.norm(level, axis=1, keepdims=True), 1e-9)
    return float(np.linalg.norm(level.mean(axis=0))) < _MEAN_OF_HALF_A_CIRCLE


def inside(scan: Scan, centre: FloatArray, forward: FloatArray) -> Viewpoint:
    """Return the viewpoint of somebody at `centre` (3,), m, who looks along `forward` (3,), unit."""
    return Viewpoint(centre, centre + typical_range(scan) * forward, np.array([0.0, 0, 1]), _INSIDE_FOV_RAD)


def overview(scan: Scan, camera_centre: FloatArray | None, *, forward: FloatArray | None = None) -> Viewpoint:
    """Return a viewpoint behind and above, just far enough to show scanner, camera and model.

    Args:
        scan: the scan.
        camera_centre: (3,) m, scanner frame; None: no camera yet, and room is left for one.
        forward: (3,) viewing direction, of which the horizontal part counts; None: towards the middle of the scan.
    """
    direction = (scan.mean_direction if forward is None else np.asarray(forward)) * np.array([1.0, 1, 0])
    length = float(np.linalg.norm(direction))
    forward = direction / length if length > 1e-3 else np.array([1.0, 0, 0])
    left = np.array([-forward[1], forward[0], 0.0])
    room = _ROOM * typical_range(scan) * left
    centre = np.zeros(3) if camera_centre is None else np.asarray(camera_centre, dtype=np.float64)
    # From the side away from the camera, so that neither frustum hides the other.
    aside = -left if centre @ left > 0 else left
    view = look_along(forward - _ASIDE * aside - np.array([0, 0, _ABOVE]))
    shown = np.vstack([_central_points(scan), centre, room, -room]) @ view.T
    # A point is visible where |x - middle| <= slope (z + back); the least `back` is linear in the outermost points.
    back = 0.0
    for k, fov in enumerate(_OVERVIEW_FOV_RAD):
        slope = _FILLED * np.tan(fov / 2)
        high, low = ((sign * shown[:, k] - slope * shown[:, 2]).max() for sign in (1, -1))
        back = max(back, float(high + low) / (2 * slope))
    depth = np.maximum(shown[:, 2] + back, 1e-9)
    middle = [_centred(shown[:, k], depth) for k in range(2)]
    position, target = (view.T @ np.array([*middle, z]) for z in (-back, float(np.median(shown[:, 2]))))
    return Viewpoint(position, target, np.array([0.0, 0, 1]), _OVERVIEW_FOV_RAD)


def overview_of_points(points: ArrayLike) -> Viewpoint:
    """Return a viewpoint outside and above points (N, 3), m, that lie around the origin."""
    outermost = float(np.percentile(np.linalg.norm(np.asarray(points, np.float64), axis=1), _PERCENTILES[1]))
    position = np.array([-1.0, -0.6, 0.9]) * 1.6 * outermost
    return Viewpoint(position, np.zeros(3), np.array([0.0, 0, 1]), _OVERVIEW_FOV_RAD)


def _centred(across: FloatArray, depth: FloatArray) -> float:
    """Return the position from which the outermost points at `across` and `depth` (N,) are symmetric."""
    low, high = float(across.min()), float(across.max())
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        tangents = (across - middle) / depth
        low, high = (middle, high) if tangents.max() + tangents.min() > 0 else (low, middle)
    return (low + high) / 2


def _central_points(scan: Scan) -> FloatArray:
    """Return a sample of the points (N, 3) of a scan without the outermost ones, which may be spurious."""
    seen = np.flatnonzero(scan.valid)
    at = np.divmod(seen[:: max(1, len(seen) // _SAMPLES)], scan.shape[1])
    rays = scan.geometry.ray_at(np.stack(at, axis=-1)).astype(np.float32)
    points = (rays * scan.ranges[at][:, None]).astype(np.float64)
    low, high = np.percentile(points, _PERCENTILES, axis=0)
    kept = points[((points >= low) & (points <= high)).all(axis=1)]
    return kept if len(kept) else points


def nudged(camera_from_scanner: Rigid, *, shift_m: ArrayLike = (0, 0, 0), turn_rad: ArrayLike = (0, 0, 0)) -> Rigid:
    """Return the pose of a camera that was moved and turned by hand, as its operator sees it.

    Args:
        camera_from_scanner: its pose before.
        shift_m: (3,) m to the right, down and forward.
        turn_rad: (3,) rotation vector about its own axes: a positive first component looks up, a positive second one to
            the right, a positive third one tilts it clockwise. It turns about its centre.
    """
    axes = camera_from_scanner.rotation
    centre = camera_from_scanner.centre + axes.T @ np.asarray(shift_m, dtype=np.float64)
    turn = rotation_from_rotvec(np.asarray(turn_rad, dtype=np.float64))
    return Rigid.from_centre(turn.T @ axes, centre)
