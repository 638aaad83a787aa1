"""Pinhole views of a wide camera: along its axis, and the faces of a cube around its centre."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera.model import CameraModel
from ladarreg_core.camera.pinhole import Camera
from ladarreg_core.foundations.arrays import BoolArray, FloatArray

_AXIAL_HALF_ANGLE_RAD = np.deg2rad(40)
_SAMPLES = 97
# Rows: the X, Y and Z axes of the face in camera axes.
_TURNS: tuple[tuple[tuple[int, int, int], ...], ...] = (
    ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
    ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
)


@dataclass(frozen=True, slots=True, eq=False)
class Face:
    """A face of the cube around a camera, of 90 degrees; the directions of all faces cover the sphere once."""

    camera: Camera
    """Its ideal pinhole, with a margin of a few pixels beyond the 90 degrees."""
    face_from_camera: NDArray[np.float64]
    """(3, 3) rotation."""

    def holds(self, points_face: FloatArray) -> BoolArray:
        """Return which points (..., 3), in the axes of the face, are seen in it rather than in another face."""
        x, y, z = points_face[..., 0], points_face[..., 1], points_face[..., 2]
        with np.errstate(invalid="ignore"):
            return np.asarray((z > 0) & (z >= np.abs(x)) & (z >= np.abs(y)))


def cube_faces(camera: CameraModel, *, scale: float = 1.0, margin_px: int = 3) -> tuple[Face, ...]:
    """Return the faces that a camera's image extends to.

    Args:
        camera: a camera of any model.
        scale: pixels of a face per pixel of the image, at the middle of both.
        margin_px: pixels beyond the 90 degrees.
    """
    half = max(4, int(np.ceil(camera.focal_px * scale)))
    size = 2 * (half + margin_px)
    pinhole = Camera.from_focal(size, size, half)
    u = np.linspace(-0.5, camera.width - 0.5, _SAMPLES)
    v = np.linspace(-0.5, camera.height - 0.5, _SAMPLES)
    rays = camera.unproject(np.stack(np.meshgrid(u, v), axis=-1)).reshape(-1, 3)
    found = (Face(pinhole, np.array(turn, dtype=np.float64)) for turn in _TURNS)
    return tuple(face for face in found if face.holds(rays @ face.face_from_camera.T).any())


def axial_pinhole(camera: CameraModel) -> Camera:
    """Return an ideal pinhole along a camera's axis: the camera without its distortion, or 80 degrees of a wide one."""
    if isinstance(camera, Camera):
        return camera.without_distortion()
    focal = camera.focal_px
    width, height = (2 * max(1, round(min(n / 2, focal * np.tan(_AXIAL_HALF_ANGLE_RAD)))) for n in camera.size)
    return Camera.from_focal(width, height, focal)
