"""Photographs as Potree's loaders read them: oriented images with their cameras, and 360-degree images.

An oriented image is a plane at a distance of f / height from its camera's place, one metre high, seen from there as the
photograph sees the scene; all images of a list share one camera, which has neither a lens nor a principal point: it
looks through the middle of the picture. Its axes are x right, y up, looking along -z, turned by three.js's Euler angles
in the order XYZ: world_from_camera = Rx(omega) Ry(phi) Rz(kappa).

A 360-degree image is drawn on a sphere, whose axes are x towards the middle of the picture, y up, z to the right,
turned in the order ZYX: world_from_sphere = Rz(90 - course) Ry(-pitch) Rx(roll + 90).

Source: Potree 1.8, `src/modules/OrientedImages/OrientedImages.js` and `src/modules/Images360/Images360.js`; three.js,
`Euler`, `SphereGeometry`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import Camera, CameraModel, EquirectangularCamera
from ladarreg_core.foundations.arrays import FloatArray

CAMERA_FROM_IMAGE = np.diag([1.0, -1.0, -1.0])
"""(3, 3) rotation from the axes of an oriented image to those of its camera (x right, y down, z forward)."""
CAMERA_FROM_SPHERE = np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])
"""(3, 3) rotation from the axes of a sphere to those of its camera."""
_NEGLIGIBLE_PX = 0.1
_LOCKED = 1e-6  # cosine of the middle angle, below which only the sum or difference of the others is known
_MAX_PANORAMA_PX = 8192  # width; larger ones would be reduced by many graphics cards


def oriented_camera(camera: Camera) -> Camera:
    """Return the camera of the picture that is written: its own, or one that looks through its middle, without lens."""
    width, height = camera.size
    ideal = Camera.from_focal(width, height, camera.focal_px)
    off = [
        camera.cx - ideal.cx,
        camera.cy - ideal.cy,
        (camera.fx / ideal.fx - 1) * width / 2,
        (camera.fy / ideal.fy - 1) * height / 2,
    ]
    return camera if not any(camera.distortion) and max(map(abs, off)) < _NEGLIGIBLE_PX else ideal


def panorama_camera(camera: CameraModel) -> EquirectangularCamera:
    """Return the whole sphere that is written: its own, or one of about the same resolution at its middle."""
    panorama = camera.as_panorama
    if panorama is not None and panorama.window is None:
        return panorama
    width = min(2 * round(np.pi * camera.focal_px), _MAX_PANORAMA_PX)
    return EquirectangularCamera(width, max(1, width // 2))


def camera_xml(camera: CameraModel) -> str:
    """Return the file of a camera for Potree's `OrientedImageLoader`."""
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<calibration>\n  <projection>frame</projection>\n'
        f"  <width>{camera.width}</width>\n  <height>{camera.height}</height>\n  <f>{camera.focal_px!r}</f>\n"
        "</calibration>\n"
    )


def oriented_angles_deg(world_from_camera: FloatArray) -> tuple[float, float, float]:
    """Return omega, phi and kappa of a camera's rotation (3, 3)."""
    turn = np.asarray(world_from_camera) @ CAMERA_FROM_IMAGE
    across = float(np.hypot(turn[0, 0], turn[0, 1]))
    phi = np.arctan2(turn[0, 2], across)
    if across < _LOCKED:
        return _degrees(np.arctan2(turn[2, 1], turn[1, 1]), phi, 0.0)
    return _degrees(np.arctan2(-turn[1, 2], turn[2, 2]), phi, np.arctan2(-turn[0, 1], turn[0, 0]))


def panorama_angles_deg(world_from_camera: FloatArray) -> tuple[float, float, float]:
    """Return course, pitch and roll of a camera's rotation (3, 3)."""
    turn = np.asarray(world_from_camera) @ CAMERA_FROM_SPHERE
    across = float(np.hypot(turn[0, 0], turn[1, 0]))
    about_y = np.arctan2(-turn[2, 0], across)
    if across < _LOCKED:
        about_x, about_z = np.arctan2(-turn[1, 2], turn[1, 1]), 0.0
    else:
        about_x, about_z = np.arctan2(turn[2, 1], turn[2, 2]), np.arctan2(turn[1, 0], turn[0, 0])
    x, y, z = _degrees(about_x, about_y, about_z)
    return 90.0 - z, -y, x - 90.0


def oriented_line(name: str, place: FloatArray, world_from_camera: FloatArray) -> str:
    """Return the line of a photograph in the list of a camera: its file, x y z (m), omega phi kappa (deg)."""
    return " ".join([name, *map(repr, (*_floats(place), *oriented_angles_deg(world_from_camera)))])


def panorama_line(name: str, place: FloatArray, world_from_camera: FloatArray) -> str:
    """Return the line of a panorama in `coordinates.txt`: its file, a time, x y z (m), course pitch roll (deg)."""
    return "\t".join([f'"{name}"', "0", *map(repr, (*_floats(place), *panorama_angles_deg(world_from_camera)))])


ORIENTED_HEADER = (
    "# file x y z (m) omega phi kappa (deg): world_from_camera = Rx Ry Rz; x right, y up, looking along -z"
)
"""First line of a list of oriented images, which is not read."""
PANORAMA_HEADER = "File\tTime\tLong\tLat\tAlt\tcourse\tpitch\troll"
"""First line of `coordinates.txt`, which is not read; Long, Lat and Alt are x, y and z."""


def _degrees(*angles: float | NDArray[np.float64]) -> tuple[float, float, float]:
    x, y, z = (float(np.degrees(angle)) for angle in angles)
    return x, y, z


def _floats(values: FloatArray) -> list[float]:
    return [float(value) for value in values]
