"""What every camera model can do, and the camera of the JSON fields of any of them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.foundations.arrays import FloatArray

if TYPE_CHECKING:
    from ladarreg_core.camera.equirectangular import EquirectangularCamera
    from ladarreg_core.camera.fisheye import FisheyeCamera
    from ladarreg_core.camera.pinhole import Camera


class CameraModel(Protocol):
    """A camera of any model: pixels are (u, v), with (0, 0) at the centre of the top-left pixel.

    The camera frame is X right, Y down, Z forward. All models are frozen and compare by value.
    """

    @property
    def model(self) -> str:
        """`pinhole`, `fisheye` or `equirectangular`, as in the camera JSON."""

    @property
    def width(self) -> int:
        """Pixels."""

    @property
    def height(self) -> int:
        """Pixels."""

    @property
    def size(self) -> tuple[int, int]:
        """(width, height), pixels."""

    @property
    def focal_px(self) -> float:
        """Pixels per radian at the centre of the image."""

    @property
    def as_pinhole(self) -> Camera | None:
        """The camera itself if straight edges are straight in its image but for a lens; None: it is wider."""

    @property
    def as_focal(self) -> Camera | FisheyeCamera | None:
        """The camera itself if it has a focal length, a principal point and terms of a lens; None: it has not."""

    @property
    def as_panorama(self) -> EquirectangularCamera | None:
        """The camera itself if its pixels are longitude and latitude; None: they are not."""

    @property
    def turn_px(self) -> float:
        """Width of a full turn, px: its left and right borders are one meridian; 0: they are not."""

    def depth_of(self, points_camera: FloatArray) -> FloatArray:
        """Return the depth (...) of points (..., 3), camera frame, m: z of a pinhole, else the distance."""

    def project(self, points_camera: ArrayLike) -> FloatArray:
        """Project points (..., 3), camera frame, m; float32 stays float32.

        Returns:
            uv (..., 2), pixels; NaN for directions that the model maps to no pixel. Others may lie outside the image.
        """

    def project_with_jacobian(self, points_camera: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return uv (..., 2) as `project`, and its derivative by the point (..., 2, 3), px/m."""

    def unproject(self, uv: ArrayLike) -> NDArray[np.float64]:
        """Return the unit rays (..., 3), camera frame, of pixels (..., 2); NaN for pixels that no ray maps to."""

    def contains(self, uv: ArrayLike, *, border: float = 0.0) -> NDArray[np.bool_]:
        """Return which pixels (..., 2) lie within the image, `border` pixels inside its outermost pixel centres."""

    def difference(self, uv: ArrayLike, reference: ArrayLike) -> FloatArray:
        """Return uv - reference (..., 2), px; across the seam of a full turn the shorter way round."""

    def scaled(self, factor: float) -> CameraModel:
        """Return the camera of the image resized by `factor`, outer borders fixed; sizes are rounded."""

    def resized(self, width: int, height: int) -> CameraModel:
        """Return the camera of the image resized to `width` x `height` pixels, outer borders fixed."""

    def as_fields(self) -> dict[str, Any]:
        """Return the fields of the camera JSON."""

    def to_json(self) -> str:
        """Return the camera JSON as text."""


def camera_from_model_fields(fields: Mapping[str, Any]) -> CameraModel:
    """Return the camera of the fields of a camera JSON of version 2.

    Args:
        fields: as `CameraModel.as_fields` returns them; without `model` the camera is a pinhole.

    Raises:
        CameraError: if a field is missing or unknown to the model, a value is impossible, or the model is unknown.
    """
    from ladarreg_core.camera.equirectangular import EquirectangularCamera
    from ladarreg_core.camera.fisheye import FisheyeCamera
    from ladarreg_core.camera.pinhole import Camera
    from ladarreg_core.errors import CameraError

    model = fields.get("model", "pinhole")
    needed: tuple[str, ...] = ("width", "height")
    if model in ("pinhole", "fisheye"):
        needed = (*needed, "fx", "fy", "cx", "cy")
    elif model != "equirectangular":
        raise CameraError(
            f"the camera model is {str(model)[:40]!r}; it must be pinhole, fisheye or equirectangular: convert the "
            "camera to one of these"
        )
    missing = [name for name in needed if name not in fields]
    if missing:
        raise CameraError(f"the {model} camera lacks {', '.join(missing)}; it needs {', '.join(needed)}")
    given = {name: fields[name] for name in needed}
    if model == "equirectangular":
        return EquirectangularCamera(**given, window=fields.get("window"))
    kind = Camera if model == "pinhole" else FisheyeCamera
    return kind(**given, distortion=fields.get("distortion", ()))


def camera_from_json(text: str) -> CameraModel:
    """Return the camera of any model of a camera JSON, as `to_json` writes it.

    Raises:
        CameraError: if the text is not JSON of a camera, or a value is impossible.
    """
    from ladarreg_core.errors import CameraError

    try:
        fields = json.loads(text)
    except (ValueError, TypeError):
        fields = None
    if not isinstance(fields, dict):
        raise CameraError("the text is not the JSON of a camera; it must be an object with width, height, fx, ...")
    return camera_from_model_fields(fields)


def require_pinhole(camera: CameraModel, what: str) -> Camera:
    """Return the camera as a pinhole.

    Args:
        camera: a camera of any model.
        what: what needs a pinhole, at the beginning of a sentence.

    Raises:
        CameraError: if it is of another model.
    """
    from ladarreg_core.errors import CameraError

    pinhole = camera.as_pinhole
    if pinhole is None:
        raise CameraError(
            f"{what} needs a perspective photograph, and the camera of this one is {camera.model}; register it "
            "automatically or by drawn matches, or cut a perspective view out of it"
        )
    return pinhole


def describe_in_short(camera: CameraModel) -> str:
    """Return a camera in a phrase, e.g. 'fisheye, f 350.0 px'."""
    if camera.as_panorama is not None:
        return f"panorama, {np.degrees(1 / camera.focal_px):.3f} degrees a pixel"
    return ("fisheye, " if camera.model == "fisheye" else "") + f"f {camera.focal_px:.1f} px"


def require_camera(value: object, name: str) -> CameraModel:
    """Return a value that is a camera.

    Raises:
        CameraError: if it is not.
    """
    from ladarreg_core.camera.equirectangular import EquirectangularCamera
    from ladarreg_core.camera.fisheye import FisheyeCamera
    from ladarreg_core.camera.pinhole import Camera
    from ladarreg_core.errors import CameraError
    from ladarreg_core.foundations.validation import require_type

    if not isinstance(value, Camera | FisheyeCamera | EquirectangularCamera):
        return require_type(value, Camera, name, error=CameraError)
    return value
