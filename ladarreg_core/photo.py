"""The photograph: pixels and the camera that took them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from ladarreg_core.camera import Camera, CameraModel, describe_in_short, require_camera, require_pinhole
from ladarreg_core.errors import OptionError, ShapeError
from ladarreg_core.foundations.arrays import ByteArray, FloatArray, read_only
from ladarreg_core.foundations.source import Source
from ladarreg_core.foundations.temperatures import thermal_gray
from ladarreg_core.foundations.validation import require_number, require_positive


@dataclass(frozen=True, eq=False, repr=False)
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
    alternatives: tuple[CameraModel, ...] = ()
    """Other cameras that the file's statements admit as well, e.g. where EXIF does not say whether a focal length is
    that of the image or of the whole sensor; what differs is then uncertain to that extent."""
    temperature_k: FloatArray | None = None
    """(H, W) float32, of a thermal image: apparent temperature, K; `pixels` are then gray levels for display."""
    source: Source | None = None
    """The file that `read_photo` read it from; None: it was made otherwise."""

    @property
    def pinhole(self) -> Camera:
        """The camera, for work in the plane of a perspective image.

        Raises:
            CameraError: if it is of another model.
        """
        return require_pinhole(self.camera, "This work")

    def __repr__(self) -> str:
        return f"Photo({self.name!r}: {', '.join(self._described)})"

    def _repr_html_(self) -> str:
        """Return what a notebook shows: the camera and the picture."""
        from ladarreg_core.foundations.card import card, thumbnail

        size, camera, *kind = self._described
        facts = [("size", size), ("camera", camera), ("kind", ", ".join(kind))]
        return card(f"Photo {self.name}", facts, picture=thumbnail(self.pixels, "the photograph"), notes=self.notes)

    @property
    def _described(self) -> list[str]:
        """Size, camera, how it is known, and whether the picture is thermal, in words."""
        kind = "calibrated" if self.calibrated else "focal length only" if self.assumed else "given camera"
        width, height = self.camera.size
        thermal = ["thermal"] if self.temperature_k is not None else []
        return [f"{width} x {height} px", describe_in_short(self.camera), kind, *thermal]

    @staticmethod
    def from_array(
        pixels: ArrayLike,
        *,
        camera: CameraModel | None = None,
        focal_px: float | None = None,
        focal_mm: float | None = None,
        sensor_mm: float | None = None,
        white: float | None = None,
        black: float = 0.0,
        name: str = "photo",
    ) -> Photo:
        """Return the photograph of an array of pixels with its camera.

        Args:
            pixels: (H, W), (H, W, 1) or (H, W, 3) RGB; uint8, uint16 or floating point. OpenCV reads BGR: reverse it.
            camera: a calibrated camera of this image size.
            focal_px: instead, a focal length in pixels of this image; the principal point is then the image's middle.
            focal_mm: instead, a focal length in millimetres, with `sensor_mm`.
            sensor_mm: the sensor's longer side, along the image's longer side.
            white: the value that becomes 255; None: 255 of uint8, 65535 of uint16, 1 of floating point. Values between
                `black` and it are scaled linearly, those beyond are cut off.
            black: the value that becomes 0.
            name: display name.

        Raises:
            OptionError: unless exactly one of camera, `focal_px` and `focal_mm` is given, or if `white` is needed: most
                of a floating-point image lies beyond 1.
            ShapeError: if the array is not an image, or the camera is of another size.
            CameraError: if the focal length is impossible.
        """
        eight_bit, note = _eight_bit(pixels, white, black)
        height, width = eight_bit.shape[:2]
        given = [key for key, value in (("camera", camera), ("focal_px", focal_px), ("focal_mm", focal_mm))
                 if value is not None]  # fmt: skip
        if len(given) != 1:
            raise OptionError(f"{' and '.join(given) or 'no camera'} given; give one of camera, focal_px and focal_mm")
        notes = () if note is None else (note,)
        if camera is not None:
            return Photo(eight_bit, camera, name=name, notes=notes, calibrated=True)
        if focal_mm is not None:
            require_positive(focal_mm, "focal_mm", unit="mm")
            if sensor_mm is None:
                raise OptionError("focal_mm is given without sensor_mm; give both (the sensor's longer side in mm)")
            require_positive(sensor_mm, "sensor_mm", unit="mm")
            focal_px = focal_mm / sensor_mm * max(width, height)
        assert focal_px is not None
        return Photo(
            eight_bit, Camera.from_focal(width, height, focal_px), name=name,
            notes=(*notes, f"focal length {focal_px:.1f} px, as given; no lens distortion is assumed"), assumed=True,
        )  # fmt: skip

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
        for other in self.alternatives:
            require_camera(other, "an alternative camera")
            if other.size != self.camera.size:
                raise ShapeError(f"an alternative camera is {other.size}, the photo's {self.camera.size}")
        object.__setattr__(self, "alternatives", tuple(self.alternatives))
        object.__setattr__(self, "notes", tuple(self.notes))


@dataclass(frozen=True, slots=True, eq=False)
class TimedPhoto:
    """A photograph, and when it was taken."""

    after_s: float
    """Its time stamp minus that of the scan that it belongs to, s."""
    photo: Photo
    """The photograph."""


def thermal_photo(
    temperature_k: ArrayLike, camera: CameraModel, *, name: str = "photo", notes: tuple[str, ...] = ()
) -> Photo:
    """Return a thermal image as a photograph, with gray pixels for display.

    Args:
        temperature_k: (H, W) apparent temperature, K.
        camera: its intrinsics.
        name: its name for people.
        notes: remarks for the operator.

    Raises:
        ShapeError: if it is not an image of positive temperatures, or not of the camera's size.
    """
    kelvin = np.asarray(temperature_k, dtype=np.float32)
    if kelvin.ndim != 2 or not kelvin.size or not (np.isfinite(kelvin).all() and (kelvin > 0).all()):
        raise ShapeError(
            "the thermal image is not (H, W) of finite temperatures above 0 K; give temperatures in kelvin"
        )
    shown = np.clip(np.rint(_CENTRE_GRAY + _SHOWN * thermal_gray(kelvin)), 0, 255).astype(np.uint8)
    return Photo(np.repeat(shown[..., None], 3, axis=-1), camera, name=name, notes=notes, temperature_k=kelvin)


_USUAL_WHITE = {"u1": 255.0, "u2": 65535.0, "f": 1.0}
_MAX_BEYOND = 0.5
_CENTRE_GRAY, _SHOWN = 128.0, 0.5  # of `thermal_gray`, as displayed


def _eight_bit(pixels: ArrayLike, white: float | None, black: float) -> tuple[ByteArray, str | None]:
    """Return (H, W, 3) uint8, and a note on the scaling, if there was one."""
    values = np.asarray(pixels)
    if values.ndim == 2:
        values = values[..., None]
    if values.ndim != 3 or values.shape[2] not in (1, 3):
        raise ShapeError(f"the pixels have the shape {values.shape}; they must be (H, W), (H, W, 1) or (H, W, 3)")
    kind = "f" if values.dtype.kind == "f" else values.dtype.str[1:]
    if kind not in _USUAL_WHITE:
        raise ShapeError(f"the pixels are {values.dtype}; they must be uint8, uint16 or floating point")
    require_number(black, "black")
    if white is None:
        white = _USUAL_WHITE[kind]
        if kind == "f" and np.mean(values > white) > _MAX_BEYOND:
            raise OptionError(
                f"the pixels are floating point and reach {np.nanmax(values):g}, and it is not said which value is "
                "white; give it as `white`, e.g. 255"
            )
    require_number(white, "white")
    if not white > black:
        raise OptionError(f"white is {white:g} and black {black:g}; white must be the larger one")
    three = np.repeat(values, 3, axis=2) if values.shape[2] == 1 else values
    if kind == "u1" and (black, white) == (0, 255):
        return three, None
    scaled = np.clip((np.nan_to_num(three.astype(np.float32), nan=black) - black) * (255 / (white - black)), 0, 255)
    return np.rint(scaled).astype(np.uint8), f"pixel values from {black:g} to {white:g} were scaled to 8 bits"
