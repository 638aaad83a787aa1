"""Photographs: the picture the right way up, and the camera that took it."""

from __future__ import annotations

import math
import numbers
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from numpy.typing import NDArray

from ladarreg_core.arrays import FloatArray
from ladarreg_core.camera import Camera
from ladarreg_core.errors import CameraError, OptionError
from ladarreg_core.formats.budget import ReadBudget
from ladarreg_core.formats.camera_file import read_camera
from ladarreg_core.formats.exif import focal_from_exif, orientation_of, upright
from ladarreg_core.formats.image_file import as_rgb, read_image
from ladarreg_core.formats.untrusted import PathLike, one_line, reading
from ladarreg_core.photo import Photo
from ladarreg_core.thermal import kelvin_of, thermal_photo

_FREEZING_K = 273.15
_POSSIBLE = (0.05, 100.0)
"""Focal length over the longer side; lenses lie between 0.3 and 35, what lies far outside was mistyped."""
_USUAL = (0.5, 10.0)


def read_photo(
    path: PathLike,
    *,
    camera: Camera | PathLike | None = None,
    focal_px: float | None = None,
    focal_mm: float | None = None,
    sensor_mm: float | None = None,
    memory_bytes: int | None = None,
) -> Photo:
    """Read a photograph with its camera.

    The camera is the one given, or a distortion-free one of the focal length given, or of the one in EXIF.

    Args:
        path: a PNG, JPEG, TIFF, WebP or BMP; gray and 16-bit pictures become 8-bit RGB, but for a gray picture of 16
            bits in centikelvin or of floating point in kelvin (`kelvin_of`), which is a thermal one.
        camera: a camera, or a file of one. Its size then says whether it was calibrated on raw or on turned pixels.
        focal_px: focal length in pixels of this picture.
        focal_mm: focal length, mm; needs `sensor_mm`.
        sensor_mm: the sensor's width, mm: that of the picture before any turn by EXIF.
        memory_bytes: memory that the read may use, bytes; None: see `budget`.

    Raises:
        FormatError: if the file is no picture, is damaged, or would need more memory than it may use.
        CameraError: if no focal length is given or found, no lens has the one given, or the picture has not the
            camera's size.
        OptionError: if the options contradict each other or are not positive.
    """
    _check_options(camera, focal_px, focal_mm, sensor_mm)
    given = camera if camera is None or isinstance(camera, Camera) else read_camera(camera)
    with reading(path) as file:
        image = read_image(file, budget=ReadBudget.of(file.stat().st_size, memory_bytes))
        kelvin = kelvin_of(image.values)
        values, depth_note = as_rgb(image.values) if kelvin is None else (kelvin, _thermal_note(kelvin))
        notes = [depth_note] if depth_note else []
        orientation = orientation_of(image.exif)
        raw_height, raw_width = values.shape[:2]
        if given is not None:
            turned = _is_turned(given, raw_width, raw_height, orientation)
            if orientation != 1:
                notes.append(
                    f"EXIF orientation {orientation} was applied"
                    if turned
                    else f"EXIF orientation {orientation} was not applied: the camera has the size of the raw pixels"
                )
            pixels = upright(values, orientation) if turned else values
            return _photo(pixels, given, file.stem, notes, calibrated=True)
        focal, note = _focal(image.exif, raw_width, raw_height, focal_px, focal_mm, sensor_mm)
        pixels = upright(values, orientation)
        if orientation != 1:
            notes.append(f"EXIF orientation {orientation} was applied")
        notes.append(note)
        height, width = pixels.shape[:2]
        return _photo(pixels, Camera.from_focal(width, height, focal), file.stem, notes, calibrated=False)


def _photo(values: NDArray[Any], camera: Camera, name: str, notes: list[str], *, calibrated: bool) -> Photo:
    if values.ndim == 2:
        return replace(thermal_photo(values, camera, name=name, notes=tuple(notes)), calibrated=calibrated)
    return Photo(values, camera, name=name, notes=tuple(notes), calibrated=calibrated)


def _thermal_note(kelvin: FloatArray) -> str:
    low, high = (float(v) - _FREEZING_K for v in (kelvin.min(), kelvin.max()))
    return f"taken as a thermal picture, {low:.1f} to {high:.1f} C"


def _check_options(camera: object, focal_px: float | None, focal_mm: float | None, sensor_mm: float | None) -> None:
    for name, value in (("focal_px", focal_px), ("focal_mm", focal_mm), ("sensor_mm", sensor_mm)):
        if value is not None and not (isinstance(value, numbers.Real) and math.isfinite(value) and value > 0):
            raise OptionError(f"{name} is {one_line(value, 40)}; it must be a positive number")
    ways = [name for name, value in (("a camera", camera), ("focal_px", focal_px), ("focal_mm", focal_mm))
            if value is not None]  # fmt: skip
    if len(ways) > 1:
        raise OptionError(f"{' and '.join(ways)} are given; give one of them")
    if (focal_mm is None) != (sensor_mm is None) and not (camera or focal_px):
        there, missing = ("focal_mm", "sensor_mm") if sensor_mm is None else ("sensor_mm", "focal_mm")
        raise OptionError(f"{there} is given without {missing}; give both (the sensor's width in mm)")


def _check_possible(focal_px: float, width: int, height: int) -> None:
    longer = max(width, height)
    low, high = _POSSIBLE
    if not low * longer <= focal_px <= high * longer:
        usual = " to ".join(f"{round(share * longer)}" for share in _USUAL)
        raise CameraError(
            f"a focal length of {focal_px:.3g} px does not fit a picture of {width} x {height} pixels, where most "
            f"lenses have {usual} px; check the figures and their units"
        )


def _is_turned(camera: Camera, raw_width: int, raw_height: int, orientation: int) -> bool:
    """Tell whether the camera belongs to the picture as EXIF turns it: its size decides.

    Where both fit (half turns, mirrored or square pictures) the turned one is meant: OpenCV, with which cameras are
    calibrated, turns pictures silently.
    """
    turned = (raw_height, raw_width) if orientation >= 5 else (raw_width, raw_height)
    if camera.size == turned:
        return True
    if camera.size == (raw_width, raw_height):
        return False
    either = f" ({turned[0]} x {turned[1]} turned by EXIF)" if turned != (raw_width, raw_height) else ""
    raise CameraError(
        f"the picture is {raw_width} x {raw_height} pixels{either}, the camera {camera.width} x {camera.height}; "
        "give the camera of this picture size"
    )


def _focal(
    tags: Mapping[int, Any],
    raw_width: int,
    raw_height: int,
    focal_px: float | None,
    focal_mm: float | None,
    sensor_mm: float | None,
) -> tuple[float, str]:
    if focal_px is not None:
        _check_possible(focal_px, raw_width, raw_height)
        return focal_px, f"focal length {focal_px:.1f} px, as given; the lens is taken as free of distortion"
    if focal_mm is not None and sensor_mm is not None:
        focal = focal_mm / sensor_mm * raw_width
        _check_possible(focal, raw_width, raw_height)
        return focal, f"focal length {focal:.1f} px from {focal_mm:g} mm and a sensor {sensor_mm:g} mm wide"
    found = focal_from_exif(tags, raw_width, raw_height)
    if found is None:
        raise CameraError(
            "the picture does not tell its focal length (no EXIF); give --camera FILE, --focal-px, or --focal-mm with "
            "--sensor-mm"
        )
    return found.focal_px, f"focal length {found.focal_px:.1f} px from {found.source}"
