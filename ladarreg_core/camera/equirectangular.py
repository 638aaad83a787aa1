"""The equirectangular camera: longitude and latitude are proportional to the pixel, as in stitched panoramas."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.camera.fields import as_number, checked_size
from ladarreg_core.errors import CameraError
from ladarreg_core.foundations.arrays import FloatArray

FULL_WINDOW = (-180.0, 90.0, 180.0, -90.0)
"""The window of a whole sphere."""
_TOLERANCE_DEG = 1e-6


@dataclass(frozen=True, repr=False)
class EquirectangularCamera:
    """A panorama, or a window of one; the interface is that of `CameraModel`.

    Longitude is 0 along the camera's Z axis and grows to the right; latitude is 0 there and grows upwards. The outer
    borders of the image are those of its window. A window of a full turn wraps: its left and right borders are the
    same meridian, the seam.

    Raises:
        CameraError: if a size is not positive, or the window is not a part of the sphere.
    """

    width: int
    """Pixels."""
    height: int
    """Pixels."""
    window: tuple[float, float, float, float] | None = None
    """Longitude of the left border, latitude of the top, longitude of the right border, latitude of the bottom,
    degrees; None: the whole sphere."""

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            object.__setattr__(self, name, checked_size(getattr(self, name), name))
        if self.window is None:
            return
        try:
            window = tuple(as_number(value) for value in self.window)
        except TypeError:
            window = ()
        if len(window) != 4 or not _is_part_of_sphere(window):
            raise CameraError(
                f"the window of the panorama is {self.window!r:.100}; it must be [left, top, right, bottom] in "
                "degrees, with left < right by at most 360, and 90 >= top > bottom >= -90"
            )
        object.__setattr__(self, "window", None if window == FULL_WINDOW else window)

    def __repr__(self) -> str:
        window = "whole sphere" if self.window is None else "window {:g}, {:g} to {:g}, {:g} deg".format(*self.window)
        return f"EquirectangularCamera({self.width} x {self.height} px, {window})"

    @property
    def model(self) -> str:
        """`equirectangular`."""
        return "equirectangular"

    @property
    def size(self) -> tuple[int, int]:
        """(width, height), pixels."""
        return self.width, self.height

    @property
    def focal_px(self) -> float:
        """The geometric mean of the pixels per radian of longitude and of latitude."""
        return float(np.sqrt(self._scale[0] * self._scale[1]))

    @property
    def is_full_turn(self) -> bool:
        """Whether the left and right borders are the same meridian."""
        left, _, right, _ = self._window_rad
        return bool(right - left > 2 * np.pi - np.radians(_TOLERANCE_DEG))

    @property
    def as_panorama(self) -> EquirectangularCamera:
        """The camera itself."""
        return self

    @property
    def turn_px(self) -> float:
        """The width of a full turn, px; 0: the window is less than that."""
        return float(self.width) if self.is_full_turn else 0.0

    @property
    def as_pinhole(self) -> None:
        """None: no plane holds its image."""

    @property
    def as_focal(self) -> None:
        """None: it has no focal length."""

    def depth_of(self, points_camera: FloatArray) -> FloatArray:
        """Return the distance (...) of points (..., 3) from the camera's center, m."""
        x, y, z = np.moveaxis(points_camera, -1, 0)
        return np.asarray(np.sqrt(np.square(x) + np.square(y) + np.square(z)))

    def as_fields(self) -> dict[str, Any]:
        """Return the fields of the camera JSON."""
        fields: dict[str, Any] = {"model": self.model, "width": self.width, "height": self.height}
        return fields if self.window is None else {**fields, "window": list(self.window)}

    def to_json(self) -> str:
        """Return the camera JSON as text; `camera_from_json` reads it."""
        return json.dumps(self.as_fields())

    def scaled(self, factor: float) -> EquirectangularCamera:
        """Return the camera of the image resized by `factor`, outer borders fixed; sizes are rounded."""
        return self.resized(max(1, round(self.width * factor)), max(1, round(self.height * factor)))

    def resized(self, width: int, height: int) -> EquirectangularCamera:
        """Return the camera of the image resized to `width` x `height` pixels, outer borders fixed."""
        return replace(self, width=width, height=height)

    def contains(self, uv: ArrayLike, *, border: float = 0.0) -> NDArray[np.bool_]:
        """Return which pixels (..., 2) lie within the image, `border` pixels inside its outermost pixel centres.

        A full turn has no borders on the left and right.
        """
        p = np.asarray(uv)
        u, v = p[..., 0], p[..., 1]
        with np.errstate(invalid="ignore"):
            across = np.isfinite(u) if self.is_full_turn else (u >= border) & (u <= self.width - 1 - border)
            inside = across & (v >= border) & (v <= self.height - 1 - border)
        return np.asarray(inside, dtype=np.bool_)

    def difference(self, uv: ArrayLike, reference: ArrayLike) -> FloatArray:
        """Return uv - reference (..., 2), px, the shorter way round."""
        found = np.array(np.asarray(uv) - np.asarray(reference))
        turn = 2 * np.pi * self._scale[0]
        found[..., 0] -= turn * np.rint(found[..., 0] / turn)
        return found

    def project(self, points_camera: ArrayLike) -> FloatArray:
        """Project points (..., 3), camera frame, m; float32 stays float32.

        Returns:
            uv (..., 2), pixels; NaN for points at the camera's centre. u is within half a turn of the window's middle.
        """
        p = np.asarray(points_camera)
        if p.dtype.kind != "f":
            p = p.astype(np.float64)
        x, y, z = p[..., 0], p[..., 1], p[..., 2]
        left, top, right, _ = self._window_rad
        middle = (left + right) / 2
        across, down = self._scale
        real = p.dtype.type
        with np.errstate(invalid="ignore", over="ignore"):
            level = np.hypot(x, z)
            turned = np.arctan2(x, z) - real(middle)
            turned = turned - real(2 * np.pi) * np.floor(turned / real(2 * np.pi) + real(0.5))
            u = turned * real(across) + real((middle - left) * across - 0.5)
            v = (real(top) - np.arctan2(-y, level)) * real(down) - real(0.5)
            nowhere = ~((level > 0) | (np.abs(y) > 0))
        return np.stack([np.where(nowhere, np.nan, u), np.where(nowhere, np.nan, v)], axis=-1).astype(p.dtype)

    def project_with_jacobian(self, points_camera: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return uv (..., 2) as `project`, and its derivative by the point (..., 2, 3), px/m; NaN at the poles."""
        p = np.asarray(points_camera, dtype=np.float64)
        x, y, z = p[..., 0], p[..., 1], p[..., 2]
        across, down = self._scale
        d_uv = np.zeros((*x.shape, 2, 3))
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            level_squared = x * x + z * z
            level, square = np.sqrt(level_squared), level_squared + y * y
            d_uv[..., 0, 0] = across * z / level_squared
            d_uv[..., 0, 2] = -across * x / level_squared
            d_uv[..., 1, 0] = -down * x * y / (level * square)
            d_uv[..., 1, 1] = down * level / square
            d_uv[..., 1, 2] = -down * y * z / (level * square)
        return self.project(p), d_uv

    def unproject(self, uv: ArrayLike) -> NDArray[np.float64]:
        """Return the unit rays (..., 3) of pixels (..., 2); NaN above and below the poles."""
        p = np.asarray(uv, dtype=np.float64)
        left, top, _, _ = self._window_rad
        across, down = self._scale
        longitude = left + (p[..., 0] + 0.5) / across
        latitude = top - (p[..., 1] + 0.5) / down
        latitude = np.where(np.abs(latitude) <= np.pi / 2 + 1e-12, latitude, np.nan)
        level = np.cos(latitude)
        return np.stack([level * np.sin(longitude), -np.sin(latitude), level * np.cos(longitude)], axis=-1)

    @property
    def _window_rad(self) -> tuple[float, float, float, float]:
        left, top, right, bottom = np.radians(self.window or FULL_WINDOW).tolist()
        return left, top, right, bottom

    @property
    def _scale(self) -> tuple[float, float]:
        """Pixels per radian of longitude and of latitude."""
        left, top, right, bottom = self._window_rad
        return self.width / (right - left), self.height / (top - bottom)


def _is_part_of_sphere(window: tuple[float, ...]) -> bool:
    left, top, right, bottom = window
    return bool(
        np.isfinite(window).all()
        and 0 < right - left <= 360 + _TOLERANCE_DEG
        and left >= -360
        and right <= 720
        and 90 + _TOLERANCE_DEG >= top > bottom >= -90 - _TOLERANCE_DEG
    )
