"""Photograph files: the upright image and its camera."""

from __future__ import annotations

import math
import numbers
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import Camera, CameraModel
from ladarreg_core.errors import CameraError, OptionError, UnderspecifiedError
from ladarreg_core.formats.cameras.camera_file import read_noted_camera
from ladarreg_core.formats.parsing.begun_read import BegunRead
from ladarreg_core.formats.parsing.budget import ReadBudget
from ladarreg_core.formats.parsing.untrusted import PathLike, one_line, reading
from ladarreg_core.formats.photos.exif import edited_since, focal_lengths, focal_mm_of, orientation_of, upright
from ladarreg_core.formats.photos.gpano import WHICH_CAMERA, looks_like_panorama, panorama_of_xmp, whole_sphere
from ladarreg_core.formats.photos.image_file import ImageData, as_rgb, read_image
from ladarreg_core.formats.photos.radiometric import radiometric_kelvin, radiometric_maker
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.foundations.source import with_source
from ladarreg_core.foundations.temperatures import TemperatureUnit, kelvin_of, needs_unit, shown_values
from ladarreg_core.photo import Photo, thermal_photo

_FREEZING_K = 273.15
_POSSIBLE = (0.05, 100.0)
"""Accepted focal lengths, relative to the longer side; real lenses lie between 0.3 and 35."""
_USUAL = (0.5, 10.0)
_SAME_FOCAL = 0.02
_SAME_CENTRE = 0.003  # of the width: what a calibration knows
_EITHER_TURN = (
    "the image's size does not show whether the camera was calibrated on the pixels as stored or as turned by EXIF, so "
    "the principal point is uncertain to that extent; store the image upright, without the tag, to settle it"
)
_CORNER = (
    "the camera file's principal point is 0, 0, the corner of the image, so it was probably never filled in: the "
    "middle of the image is assumed, and the camera does not count as calibrated; give cx and cy"
)

PhotoModel = Literal["pinhole", "equirectangular"]
"""Camera models that a photograph can have without a camera file."""


def read_photo(
    path: PathLike,
    *,
    camera: CameraModel | PathLike | None = None,
    camera_name: str | None = None,
    camera_notes: Sequence[str] = (),
    focal_px: float | None = None,
    focal_mm: float | None = None,
    sensor_mm: float | None = None,
    camera_model: PhotoModel | None = None,
    temperature_unit: TemperatureUnit | None = None,
    memory_bytes: int | None = None,
) -> Photo:
    """Read a photograph with its camera, in the calling process and with its permissions.

    The camera is `camera`, or a distortion-free pinhole with the given focal length, or else the panorama that the
    photograph's XMP describes, or a pinhole with the focal length in EXIF.

    Args:
        path: a PNG, JPEG, TIFF, WebP, AVIF or BMP, or HEIC where Pillow's plug-in is installed. Gray and 16-bit images
            are converted to 8-bit RGB; gray images with 16 bits in centikelvin or floating point in kelvin
            (`kelvin_of`) are thermal images.
        camera: a camera or a camera file. Its size shows whether it was calibrated on raw or on rotated pixels.
        camera_name: name of the camera in a file with several; None: chosen by the photograph's name and size.
        camera_notes: remarks on a given camera, which become notes of the photograph.
        focal_px: focal length, pixels of this image.
        focal_mm: focal length, mm; needs `sensor_mm`.
        sensor_mm: sensor width, mm: its longer side, along the longer side of the image. Without `focal_mm` the focal
            length is that of EXIF.
        camera_model: `equirectangular`: a panorama, of the whole sphere where its XMP does not say otherwise; `pinhole`
            even where its XMP describes a panorama. None: as its XMP says.
        temperature_unit: unit of a thermal image's pixels, where the file does not state it: `K` or `C`; `none`: they
            are no temperatures.
        memory_bytes: memory that the read may use, bytes; None: see `budget`.

    Raises:
        FormatError: if the file is not an image, is damaged, or would need more memory than it may use.
        CameraError: if no focal length is given or found, if it is implausible, or if image and camera differ in size.
        UnderspecifiedError: if the pixels may be temperatures whose unit is unknown.
        OptionError: if the options contradict each other or are not positive.
    """
    with begin_photo(
        path, camera=camera, camera_name=camera_name, camera_notes=camera_notes, focal_px=focal_px, focal_mm=focal_mm,
        sensor_mm=sensor_mm, camera_model=camera_model, temperature_unit=temperature_unit, memory_bytes=memory_bytes,
    ) as read:  # fmt: skip
        return read.result()


def begin_photo(
    path: PathLike,
    *,
    camera: CameraModel | PathLike | None = None,
    camera_name: str | None = None,
    camera_notes: Sequence[str] = (),
    memory_bytes: int | None = None,
    **known: Any,
) -> BegunRead[Photo]:
    """Begin to read a photograph; arguments and errors as of `read_photo`."""
    options = dict.fromkeys(("focal_px", "focal_mm", "sensor_mm", "camera_model", "temperature_unit")) | known
    given = Path(camera) if isinstance(camera, str | os.PathLike) else camera

    def finish(photo: Photo) -> Photo:
        if given is None:
            return with_source(photo, [path], options)
        if isinstance(given, Path):
            return with_source(photo, [path, given], {**options, "camera": given, "camera_name": camera_name})
        return with_source(photo, [path], {})  # the camera itself cannot be stated in an option

    asked = {**options, "memory_bytes": memory_bytes}
    return BegunRead(_read, (path, given, camera_name, camera_notes), asked, finish=finish)


def _read(
    path: PathLike,
    camera: CameraModel | PathLike | None,
    camera_name: str | None,
    camera_notes: Sequence[str],
    *,
    focal_px: float | None,
    focal_mm: float | None,
    sensor_mm: float | None,
    camera_model: PhotoModel | None,
    temperature_unit: TemperatureUnit | None,
    memory_bytes: int | None,
) -> Photo:
    _check_options(camera, focal_px, focal_mm, sensor_mm)
    _check_model(camera_model, camera, focal_px or focal_mm or sensor_mm)
    if camera_name is not None and not isinstance(camera, str | os.PathLike):
        raise OptionError("a camera's name is given without a camera file; give `camera` with `camera_name`")
    given: CameraModel | None = None
    if isinstance(camera, str | os.PathLike):
        name = Path(path).name if isinstance(path, str | os.PathLike) else ""
        given, camera_notes = read_noted_camera(camera, name=camera_name, picture=name, picture_file=path)
    elif camera is not None:
        given = camera
    with reading(path) as file:
        image = read_image(file, budget=ReadBudget.of(file.stat().st_size, memory_bytes))
        kelvin = _temperatures(file, image, temperature_unit)
        values, depth_note = as_rgb(image.values) if kelvin is None else (kelvin, _thermal_note(kelvin))
        notes = [*camera_notes, *image.notes, *([depth_note] if depth_note else [])]
        orientation = orientation_of(image.exif)
        raw_height, raw_width = values.shape[:2]
        if given is not None:
            turned = _is_turned(given, raw_width, raw_height, orientation)
            if orientation != 1:
                notes.append(
                    f"EXIF orientation {orientation} was applied"
                    if turned
                    else f"EXIF orientation {orientation} was not applied: the camera's size is that of the raw pixels"
                )
            pixels = upright(values, orientation) if turned else values
            others = _as_stored(given, raw_width, raw_height, orientation) if turned else ()
            if others:
                notes.append(_EITHER_TURN)
            lens = given.as_focal
            if lens is not None and lens.cx == lens.cy == 0:
                notes.append(_CORNER)
                middle = replace(lens, cx=(lens.width - 1) / 2, cy=(lens.height - 1) / 2)
                return _photo(pixels, middle, file.stem, notes, calibrated=False)
            return _photo(pixels, given, file.stem, notes, calibrated=True, alternatives=others)
        pixels = upright(values, orientation)
        if orientation != 1:
            notes.append(f"EXIF orientation {orientation} was applied")
        height, width = pixels.shape[:2]
        if camera_model != "pinhole" and not (focal_px or focal_mm or sensor_mm):
            panorama = panorama_of_xmp(image.xmp, width, height)
            if panorama is not None:
                notes.append("an equirectangular panorama, as its XMP says")
            elif camera_model is not None:
                panorama = whole_sphere(width, height)
                notes.append("an equirectangular panorama of the whole sphere, as given")
            if panorama is not None:
                return _photo(pixels, panorama, file.stem, notes, calibrated=True)
        looks_so = camera_model is None and looks_like_panorama(pixels)
        try:
            (focal, *others_px), note = _focal(image.exif, raw_width, raw_height, focal_px, focal_mm, sensor_mm)
        except CameraError as error:
            raise CameraError(f"{error}; {WHICH_CAMERA}" if looks_so else str(error)) from None
        notes += [note, *([WHICH_CAMERA] if looks_so else [])]
        camera_of = partial(Camera.from_focal, width, height)
        others = tuple(map(camera_of, others_px))
        return _photo(pixels, camera_of(focal), file.stem, notes, calibrated=False, alternatives=others)


def _temperatures(file: Path, image: ImageData, unit: TemperatureUnit | None) -> NDArray[np.float32] | None:
    """Return a thermal image's temperatures (H, W), K; None if it is a photograph."""
    if unit is not None and unit not in get_args(TemperatureUnit):
        raise OptionError(f"the unit of temperature is {one_line(unit, 20)!r}; it must be K, C or none")
    if unit is None and (maker := radiometric_maker(file)) is not None:
        return radiometric_kelvin(file, maker)
    stated: TemperatureUnit | None = unit or image.temperature_unit
    if stated is not None and (unit is not None or image.values.dtype.kind == "f"):
        return kelvin_of(image.values, stated)
    kelvin = kelvin_of(image.values)
    if kelvin is None and needs_unit(image.values):
        raise UnderspecifiedError(
            f"its pixels, {shown_values(image.values)}, may be temperatures, and the file does not state their unit; "
            "give `temperature_unit` C or K, or none if it is an ordinary picture"
        )
    return kelvin


def _photo(
    values: NDArray[Any],
    camera: CameraModel,
    name: str,
    notes: list[str],
    *,
    calibrated: bool,
    alternatives: tuple[CameraModel, ...] = (),
) -> Photo:
    known: dict[str, Any] = {"calibrated": calibrated, "assumed": not calibrated, "alternatives": alternatives}
    if values.ndim == 2:
        return replace(thermal_photo(values, camera, name=name, notes=tuple(notes)), **known)
    return Photo(values, camera, name=name, notes=tuple(notes), **known)


def _as_stored(camera: CameraModel, raw_width: int, raw_height: int, orientation: int) -> tuple[CameraModel, ...]:
    """Return the camera as it is if it was calibrated on the pixels as stored, where its size admits that, too."""
    lens = camera.as_focal
    if orientation == 1 or camera.size != (raw_width, raw_height) or lens is None:
        return ()
    if orientation >= 5:  # of a square image
        lens = replace(lens, fx=lens.fy, fy=lens.fx, cx=lens.cy, cy=lens.cx)
    flip_u, flip_v = orientation in (2, 3, 6, 7), orientation in (3, 4, 7, 8)
    cx = lens.width - 1 - lens.cx if flip_u else lens.cx
    cy = lens.height - 1 - lens.cy if flip_v else lens.cy
    turned = replace(lens, cx=cx, cy=cy)
    apart = math.hypot(turned.cx - lens.cx, turned.cy - lens.cy)
    return (turned,) if apart > _SAME_CENTRE * lens.width else ()


def _thermal_note(kelvin: FloatArray) -> str:
    low, high = (float(v) - _FREEZING_K for v in (kelvin.min(), kelvin.max()))
    return f"read as a thermal image, {low:.1f} to {high:.1f} C"


def _check_options(camera: object, focal_px: float | None, focal_mm: float | None, sensor_mm: float | None) -> None:
    for name, value in (("focal_px", focal_px), ("focal_mm", focal_mm), ("sensor_mm", sensor_mm)):
        if value is not None and not (isinstance(value, numbers.Real) and math.isfinite(value) and value > 0):
            raise OptionError(f"{name} is {one_line(value, 40)}; it must be a positive number")
    ways = [name for name, value in (("a camera", camera), ("focal_px", focal_px), ("focal_mm", focal_mm))
            if value is not None]  # fmt: skip
    if len(ways) > 1:
        raise OptionError(f"{' and '.join(ways)} are given; give one of them")
    if focal_mm is not None and sensor_mm is None:
        raise OptionError("focal_mm is given without sensor_mm; give both (the sensor's width in mm)")


def _check_model(model: str | None, camera: object, focal: float | None) -> None:
    if model is not None and model not in get_args(PhotoModel):
        raise OptionError(
            f"the camera model is {one_line(model, 40)!r}; it must be {' or '.join(get_args(PhotoModel))}; other "
            "models need a camera file (`camera`)"
        )
    if model is not None and camera is not None:
        raise OptionError("a camera model is given with a camera, which has its own; give one of them")
    if model == "equirectangular" and focal is not None:
        raise OptionError("a panorama has no focal length; omit it, or give `camera_model='pinhole'`")


def _check_possible(focal_px: float, width: int, height: int) -> None:
    longer = max(width, height)
    low, high = _POSSIBLE
    if not low * longer <= focal_px <= high * longer:
        usual = " to ".join(f"{round(share * longer)}" for share in _USUAL)
        raise CameraError(
            f"a focal length of {focal_px:.3g} px does not fit an image of {width} x {height} pixels, where most "
            f"lenses have {usual} px; check the figures and their units"
        )


def _is_turned(camera: CameraModel, raw_width: int, raw_height: int, orientation: int) -> bool:
    """Return whether the camera belongs to the image as rotated by EXIF, judged by its size.

    Where both sizes fit (half turns, mirrored or square images) the rotated image is assumed: OpenCV, with which
    cameras are calibrated, applies the orientation silently.
    """
    turned = (raw_height, raw_width) if orientation >= 5 else (raw_width, raw_height)
    if camera.size == turned:
        return True
    if camera.size == (raw_width, raw_height):
        return False
    either = f" ({turned[0]} x {turned[1]} rotated by EXIF)" if turned != (raw_width, raw_height) else ""
    raise CameraError(
        f"the image is {raw_width} x {raw_height} pixels{either}, the camera {camera.width} x {camera.height}; "
        "give a camera of this image size"
    )


def _focal(
    tags: Mapping[int, Any],
    raw_width: int,
    raw_height: int,
    focal_px: float | None,
    focal_mm: float | None,
    sensor_mm: float | None,
) -> tuple[list[float], str]:
    """Return the focal length, px, followed by others that EXIF admits, and the note on it."""
    if focal_px is not None:
        _check_possible(focal_px, raw_width, raw_height)
        return [focal_px], f"focal length {focal_px:.1f} px, as given; no lens distortion is assumed"
    notice = edited_since(tags, raw_width, raw_height)
    if sensor_mm is not None:
        stated = focal_mm or focal_mm_of(tags)
        if stated is None:
            raise OptionError("sensor_mm is given without focal_mm, and EXIF states no focal length; give both")
        longer = max(raw_width, raw_height)
        focal = stated / sensor_mm * longer
        _check_possible(focal, raw_width, raw_height)
        by = "" if focal_mm is not None else " (EXIF)"
        side = " along its longer side" if raw_height > raw_width else " wide"
        return [focal], _joined(
            f"focal length {focal:.1f} px from {stated:g} mm{by} and a sensor {sensor_mm:g} mm{side}", notice
        )
    found = focal_lengths(tags, raw_width, raw_height)
    if found:
        best, *others = found
        others = [other for other in others if abs(math.log(other.focal_px / best.focal_px)) > _SAME_FOCAL]
        or_else = "".join(f"; or {other.focal_px:.1f} px from {other.source}" for other in others)
        return [best.focal_px, *(other.focal_px for other in others)], _joined(
            f"focal length {best.focal_px:.1f} px from {best.source}{or_else}", notice
        )
    stated = focal_mm_of(tags)
    if stated is not None:
        raise CameraError(
            f"EXIF states a focal length of {stated:g} mm but not the sensor's size; give its width by `sensor_mm` "
            "(36 full frame, 23.5 APS-C, 17.3 Micro Four Thirds), or `camera` or `focal_px`"
        )
    raise CameraError(
        "the image has no focal length in EXIF; give `camera`, `focal_px`, or `focal_mm` with `sensor_mm`"
    )


def _joined(note: str, notice: str | None) -> str:
    return note if notice is None else f"{note}; {notice}"
