"""Pinhole faces of a photograph taken by a wide camera: perspective pictures cut out of it, side by side.

A face is at most 75 degrees wide, because correlation windows suffer beyond that. The faces look along the vertices of
an icosahedron: cones of 37.4 degrees around its twelve vertices cover the sphere. They overlap; every direction belongs
to the nearest face, so that no pixel counts twice.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import Camera, CameraModel
from ladarreg_core.foundations.arrays import BoolArray, FloatArray
from ladarreg_core.frames import Rigid, rotation_about
from ladarreg_core.matching.features.channels import FEW_HARMONICS
from ladarreg_core.matching.images.photo_levels import PhotoLevels, photo_levels
from ladarreg_core.photo import Photo
from ladarreg_core.surface.remap import look_up

FACE_FIELD_RAD = float(np.radians(75.0))
"""Field of view of a face."""
_MIN_SHARE = 0.04
"""Least share of the photograph's solid angle for which a face is cut out; its neighbours cover most of the rest."""
_SAMPLES = 20_000
_BORDER_PX = 12  # working pixels: the channels are blurred over the border of the picture
_MULTIPLE = 8  # of the size of a face, so that halved levels have whole sizes
_WRAPPED = 2


def icosahedron(axis: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the twelve vertices (12, 3) of an icosahedron, unit vectors; the first is `axis`, the last its opposite.

    Args:
        axis: (3,) unit vector.
    """
    latitude = np.arctan(0.5)
    turn = np.radians(72.0) * np.arange(5)
    rings = [
        np.stack([np.cos(latitude) * np.cos(t), np.cos(latitude) * np.sin(t), np.full(5, sign * np.sin(latitude))], -1)
        for sign, t in ((1, turn), (-1, turn + np.radians(36.0)))
    ]
    upright = np.concatenate([[[0.0, 0.0, 1.0]], *rings, [[0.0, 0.0, -1.0]]])
    other = np.eye(3)[int(np.argmin(np.abs(axis)))]
    first = other - axis * (other @ axis)
    first /= np.linalg.norm(first)
    return np.asarray(upright @ np.stack([first, np.cross(axis, first), axis]))


@dataclass(frozen=True, slots=True, eq=False)
class Face:
    """A pinhole picture cut out of a photograph, as seen from the same centre."""

    number: int
    """Its number among the faces of the photograph."""
    face_from_camera: Rigid
    """A pure rotation."""
    camera: Camera
    """The pinhole camera of its picture."""
    photo: Photo
    """The picture with that camera; directions outside the photograph are filled from its border."""
    seen: BoolArray
    """(h, w) bool: pixels inside the photograph."""
    own: BoolArray
    """(h, w) bool: those of `seen` whose direction is nearer to this face's axis than to any other's."""
    whole: CameraModel
    """The camera of the photograph."""

    def in_photo(self, uv: FloatArray, camera: Camera) -> FloatArray:
        """Return the photograph's pixels (..., 2) of pixels (..., 2) of the face.

        Args:
            uv: its pixels.
            camera: the pinhole camera that these pixels belong to.
        """
        return self.whole.project(camera.unproject(uv) @ self.face_from_camera.rotation)


class FaceSet:
    """The faces of one photograph.

    Args:
        photo: the photograph; its camera may be of any model.
    """

    def __init__(self, photo: Photo) -> None:
        self.photo = photo
        self._levels: dict[tuple[int, Camera, bool, int], PhotoLevels] = {}

    @cached_property
    def camera(self) -> Camera:
        """The camera of every face: square, with the resolution that the photograph has at its centre."""
        focal = self.photo.camera.focal_px
        half = focal * np.tan(FACE_FIELD_RAD / 2)
        size = max(_MULTIPLE, int(2 * half) // _MULTIPLE * _MULTIPLE)
        return Camera.from_focal(size, size, focal)

    @cached_property
    def faces(self) -> tuple[Face, ...]:
        """The faces that cover the photograph."""
        axes = _face_axes(self.photo.camera)
        turns = [Rigid(_upright(axis), np.zeros(3)) for axis in axes]
        return tuple(self._cut(k, turn, axes) for k, turn in enumerate(turns))

    def levels(self, face: Face, working: Camera, *, own: bool, harmonics: int = FEW_HARMONICS) -> PhotoLevels:
        """Return the levels of a face.

        Args:
            face: the face.
            working: the ideal camera of level 0.
            own: use only the pixels that belong to this face, instead of all inside the photograph.
            harmonics: of the channels.
        """
        key = face.number, working, own, harmonics
        if key not in self._levels:
            other = self._levels.get((face.number, working, not own, harmonics))
            levels = other or photo_levels(face.photo, working, harmonics=harmonics)
            masks = tuple(_reduced(face.own if own else face.seen, face.seen, camera) for camera in levels.cameras)
            made = replace(levels, usable=masks)
            if other is not None:  # the channels do not depend on the mask
                vars(made).update({name: vars(other)[name] for name in _SHARED if name in vars(other)})
            self._levels[key] = made
        return self._levels[key]

    def _cut(self, number: int, turn: Rigid, axes: NDArray[np.float64]) -> Face:
        camera, source = self.camera, self.photo.camera
        v, u = np.mgrid[: camera.height, : camera.width]
        rays = (camera.unproject(np.stack([u, v], axis=-1)) @ turn.rotation).astype(np.float32)
        nearest = (rays @ axes.T.astype(np.float32)).argmax(axis=-1)
        uv = source.project(rays)
        seen = source.contains(uv, border=-0.5) & np.isfinite(uv).all(axis=-1)
        inside = np.where(seen[..., None], uv, -1e4).astype(np.float32)
        values = look_up(*_wrapped(self.photo.pixels, source, inside))
        kelvin = self.photo.temperature_k
        heat = None if kelvin is None else look_up(*_wrapped(kelvin, source, inside))
        photo = replace(self.photo, pixels=values, camera=camera, temperature_k=heat)
        return Face(number, turn, camera, photo, seen, seen & (nearest == number), source)


_SHARED = ("gray", "_raw_fine", "channels", "fine_channels")


def _upright(axis: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation (face from camera) of a face along `axis` whose down is the camera's, as nearly as can be."""
    right = np.cross([0.0, 1.0, 0.0], axis)
    length = float(np.linalg.norm(right))
    right = np.array([1.0, 0.0, 0.0]) if length < 1e-6 else right / length
    return np.stack([right, np.cross(axis, right), axis])


def _face_axes(camera: CameraModel) -> NDArray[np.float64]:
    """Return the directions (F, 3), camera frame, of the faces that cover the photograph."""
    full_turn = bool(getattr(camera, "is_full_turn", False))
    axes = icosahedron(np.array([0.0, -1.0, 0.0]) if full_turn else np.array([0.0, 0.0, 1.0]))
    if full_turn:
        axes = axes @ rotation_about("y", np.radians(18.0)).T
    step = max(1, int(np.sqrt(camera.width * camera.height / _SAMPLES)))
    v, u = np.mgrid[0 : camera.height : step, 0 : camera.width : step].astype(np.float64)
    uv = np.stack([u, v], axis=-1).reshape(-1, 2)
    # The solid angle of a pixel is that of the triangle of its neighbours' rays.
    rays, right, down = (camera.unproject(uv + shift) for shift in ([0, 0], [0.5, 0], [0, 0.5]))
    area = np.linalg.norm(np.cross(right - rays, down - rays), axis=-1)
    known = np.isfinite(area)
    nearest = (rays[known] @ axes.T).argmax(axis=-1)
    share = np.bincount(nearest, area[known], len(axes))
    return np.asarray(axes[share >= _MIN_SHARE * share.sum()])


def _wrapped(picture: NDArray[Any], camera: CameraModel, uv: FloatArray) -> tuple[NDArray[Any], FloatArray, FloatArray]:
    """Return a picture continued across its seam, if it has one, and the pixels (h, w) of u and v in it."""
    u, v = uv[..., 0], uv[..., 1]
    if not getattr(camera, "is_full_turn", False):
        return picture, u, v
    wider = np.concatenate([picture[:, -_WRAPPED:], picture, picture[:, :_WRAPPED]], axis=1)
    return np.ascontiguousarray(wider), u + np.float32(_WRAPPED), v


def _reduced(mask: BoolArray, seen: BoolArray, camera: Camera) -> BoolArray:
    """Return the pixels of a level that lie in a mask, and away from the border of what the photograph shows."""
    share = cv2.resize(mask.astype(np.float32), camera.size, interpolation=cv2.INTER_AREA)
    if seen.all():
        return np.asarray(share > 0.5)
    inside = (cv2.resize(seen.astype(np.float32), camera.size, interpolation=cv2.INTER_AREA) > 0.99).astype(np.uint8)
    reach = max(2, round(_BORDER_PX * camera.width / max(camera.width, seen.shape[1] * 0.5)))
    distance = cv2.distanceTransform(inside, cv2.DIST_L2, 3)
    return np.asarray((share > 0.5) & (distance > reach))
