"""What cameras with a focal length and a principal point have in common, whatever their projection."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.camera.fields import checked_centre, checked_focal, checked_size, checked_terms
from ladarreg_core.foundations.arrays import FloatArray


@dataclass(frozen=True, repr=False)
class FocalCamera:
    """Intrinsics of a camera with a focal length; pixels are (u, v), with (0, 0) at the centre of the top-left pixel.

    Raises:
        CameraError: if a size or focal length is not positive, a focal length is implausible, a number is not finite,
            or the distortion does not have one of the permitted numbers of terms.
    """

    model: ClassVar[str]
    """Name of the model, as in the camera JSON."""
    _term_counts: ClassVar[tuple[int, ...]]

    width: int
    """Pixels."""
    height: int
    """Pixels."""
    fx: float
    """Focal length in pixel widths; of a fisheye, pixel widths per radian."""
    fy: float
    """Focal length in pixel heights, likewise."""
    cx: float
    """Principal point, pixels."""
    cy: float
    """Principal point, pixels."""
    distortion: tuple[float, ...] = ()
    """Terms of the model; empty: none."""

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            object.__setattr__(self, name, checked_size(getattr(self, name), name))
        for name in ("fx", "fy"):
            object.__setattr__(self, name, checked_focal(getattr(self, name), name))
        for name in ("cx", "cy"):
            object.__setattr__(self, name, checked_centre(getattr(self, name), name))
        object.__setattr__(self, "distortion", checked_terms(self.distortion, self._term_counts))

    def __repr__(self) -> str:
        terms = f", {len(self.distortion)} distortion terms" if self.distortion else ""
        return (
            f"{type(self).__name__}({self.width} x {self.height} px, f {self.fx:.2f} x {self.fy:.2f} px, "
            f"centre ({self.cx:.2f}, {self.cy:.2f}){terms})"
        )

    @property
    def size(self) -> tuple[int, int]:
        """(width, height), pixels."""
        return self.width, self.height

    @property
    def focal_px(self) -> float:
        """The geometric mean of fx and fy: pixels per radian at the principal point."""
        return float(np.sqrt(self.fx * self.fy))

    def as_fields(self) -> dict[str, Any]:
        """Return the fields of the camera JSON."""
        names = ("model", "width", "height", "fx", "fy", "cx", "cy")
        return {**{name: getattr(self, name) for name in names}, "distortion": list(self.distortion)}

    def to_json(self) -> str:
        """Return the camera JSON as text; `camera_from_json` reads it."""
        return json.dumps(self.as_fields())

    def scaled(self, factor: float) -> Self:
        """Return the camera of the image resized by `factor`, outer borders fixed; sizes are rounded."""
        return self.resized(max(1, round(self.width * factor)), max(1, round(self.height * factor)))

    def resized(self, width: int, height: int) -> Self:
        """Return the camera of the image resized to `width` x `height` pixels, outer borders fixed."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=(self.cx + 0.5) * sx - 0.5,
            cy=(self.cy + 0.5) * sy - 0.5,
        )

    @property
    def as_focal(self) -> Self:
        """The camera itself."""
        return self

    @property
    def as_panorama(self) -> None:
        """None: its pixels are not longitude and latitude."""

    @property
    def turn_px(self) -> float:
        """0: the image does not wrap."""
        return 0.0

    def contains(self, uv: ArrayLike, *, border: float = 0.0) -> NDArray[np.bool_]:
        """Return which pixels (..., 2) lie within the image, `border` pixels inside its outermost pixel centres."""
        p = np.asarray(uv)
        u, v = p[..., 0], p[..., 1]
        with np.errstate(invalid="ignore"):
            inside = (u >= border) & (u <= self.width - 1 - border) & (v >= border) & (v <= self.height - 1 - border)
        return np.asarray(inside, dtype=np.bool_)

    def difference(self, uv: ArrayLike, reference: ArrayLike) -> FloatArray:
        """Return uv - reference (..., 2), px."""
        return np.asarray(np.asarray(uv) - np.asarray(reference))
