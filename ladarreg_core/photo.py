"""The photograph: pixels and the camera that took them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ladarreg_core.arrays import ByteArray, FloatArray, read_only
from ladarreg_core.camera import Camera
from ladarreg_core.errors import CameraError, ShapeError
from ladarreg_core.validation import require_type


@dataclass(frozen=True, eq=False)
class Photo:
    """A picture with its intrinsics; read-only.

    Raises:
        ShapeError: if the picture has not the camera's size, or values that are no whole numbers from 0 to 255, or the
            temperatures have not the picture's size.
        CameraError: if there is no camera.
    """

    pixels: ByteArray
    """(H, W, 3) uint8, RGB; gray pictures have three equal channels."""
    camera: Camera
    """Intrinsics, for the picture as it stands here."""
    name: str = "photo"
    """What to call it."""
    notes: tuple[str, ...] = field(default=())
    """What an operator should know of the file, e.g. where the focal length came from."""
    calibrated: bool = False
    """Whether the camera comes from a calibration: then a change of a few per cent is not believed of it."""
    temperature_k: FloatArray | None = None
    """(H, W) float32, of a thermal picture: apparent temperature, K; `pixels` are then gray levels to look at."""

    def __post_init__(self) -> None:
        require_type(self.camera, Camera, "the photo's camera", error=CameraError)
        pixels = read_only(self.pixels, np.uint8, (None, None, 3), "the photo")
        height, width = pixels.shape[:2]
        if (width, height) != self.camera.size:
            raise ShapeError(
                f"the photo is {width} x {height} pixels, its camera {self.camera.width} x {self.camera.height}; "
                "give the camera of this picture size"
            )
        if self.temperature_k is not None:
            kelvin = read_only(self.temperature_k, np.float32, (height, width), "the photo's temperatures")
            object.__setattr__(self, "temperature_k", kelvin)
        object.__setattr__(self, "pixels", pixels)
        object.__setattr__(self, "notes", tuple(self.notes))
