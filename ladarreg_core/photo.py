"""The photograph: pixels and the camera that took them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ladarreg_core.arrays import ByteArray, FloatArray, read_only
from ladarreg_core.camera import Camera, CameraModel, require_camera, require_pinhole
from ladarreg_core.errors import ShapeError


@dataclass(frozen=True, eq=False)
class Photo:
    """An image with its intrinsics; read-only.

    Raises:
        ShapeError: if the image is not of the camera's size or has values other than whole numbers from 0 to 255, or
            the temperatures are not of the image's size.
        CameraError: if there is no camera.
    """

    pixels: ByteArray
    """(H, W, 3) uint8, RGB; gray images have three equal channels."""
    camera: CameraModel
    """Intrinsics, valid for these pixels."""
    name: str = "photo"
    """Display name."""
    notes: tuple[str, ...] = field(default=())
    """Remarks on the file for the operator, e.g. the source of the focal length."""
    calibrated: bool = False
    """Whether the intrinsics come from a calibration; changes of several per cent are then not accepted."""
    assumed: bool = False
    """Whether only the focal length is known, typed or from EXIF: the principal point and the distortion have a
    `CameraPrior`."""
    temperature_k: FloatArray | None = None
    """(H, W) float32, of a thermal image: apparent temperature, K; `pixels` are then gray levels for display."""

    @property
    def pinhole(self) -> Camera:
        """The camera, for work in the plane of a perspective image.

        Raises:
            CameraError: if it is of another model.
        """
        return require_pinhole(self.camera, "This work")

    def __post_init__(self) -> None:
        require_camera(self.camera, "the photo's camera")
        pixels = read_only(self.pixels, np.uint8, (None, None, 3), "the photo")
        height, width = pixels.shape[:2]
        if (width, height) != self.camera.size:
            raise ShapeError(
                f"the photo is {width} x {height} pixels, its camera {self.camera.width} x {self.camera.height}; "
                "give the intrinsics for this image size"
            )
        if self.temperature_k is not None:
            kelvin = read_only(self.temperature_k, np.float32, (height, width), "the photo's temperatures")
            object.__setattr__(self, "temperature_k", kelvin)
        object.__setattr__(self, "pixels", pixels)
        object.__setattr__(self, "notes", tuple(self.notes))
