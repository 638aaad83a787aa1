"""Panoramas: the camera that the XMP of stitched pictures states, and pictures that look like one.

Source: Google, Photo Sphere XMP metadata (namespace `http://ns.google.com/photos/1.0/panorama/`).
"""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import EquirectangularCamera
from ladarreg_core.errors import CameraError
from ladarreg_core.formats.parsing.untrusted import one_line

_NAMESPACE = b"http://ns.google.com/photos/1.0/panorama/"
_PREFIX = re.compile(rb"xmlns:([A-Za-z_][\w.-]{0,30})\s*=\s*[\"']" + re.escape(_NAMESPACE))
_LARGEST_XMP = 1 << 20
_SAME_SHAPE = 0.01
_MAX_PIXELS = 1e9
_SIZES = {
    "full_width": "FullPanoWidthPixels",
    "full_height": "FullPanoHeightPixels",
    "width": "CroppedAreaImageWidthPixels",
    "height": "CroppedAreaImageHeightPixels",
    "left": "CroppedAreaLeftPixels",
    "top": "CroppedAreaTopPixels",
}
WHICH_CAMERA = "the picture looks like an equirectangular panorama: if it is one, give `camera_model='equirectangular'`"
"""Advice on a picture that looks like a panorama."""
_SEAM_OF_STEP = 3.0
_MIN_SEAM = 1.0


def panorama_of_xmp(xmp: bytes, width: int, height: int) -> EquirectangularCamera | None:
    """Return the camera that a picture's XMP states; None if the XMP does not say that it is a panorama.

    The stated sizes are those of the stitched picture; one that was scaled since has the same window.

    Args:
        xmp: the XMP packet, which need not be well-formed; empty: there is none.
        width: pixels of the upright picture.
        height: pixels of the upright picture.

    Raises:
        CameraError: if it is a panorama of another projection, or its stated sizes contradict each other or the
            picture's.
    """
    fields = _fields(xmp)
    if fields is None:
        return None
    projection = fields.get("ProjectionType", "equirectangular").strip()
    if projection.lower() != "equirectangular":
        raise CameraError(
            f"its XMP says that it is a panorama of the projection {one_line(projection, 40)!r}; equirectangular ones "
            "are read: export it as equirectangular, or give one by `camera`"
        )
    stated = {name: _pixels(fields.get(field)) for name, field in _SIZES.items()}
    if stated["full_width"] is None or stated["full_height"] is None:
        if not is_whole_sphere(width, height):
            raise CameraError(
                f"its XMP says that it is an equirectangular panorama but not which part of the sphere its {width} x "
                f"{height} pixels show; give a camera JSON with model equirectangular and a window"
            )
        return EquirectangularCamera(width, height)
    return EquirectangularCamera(width, height, _window(stated, width, height))


def is_whole_sphere(width: int, height: int) -> bool:
    """Return whether a picture has the shape of a whole equirectangular panorama: twice as wide as high."""
    return abs(width - 2 * height) <= max(1.0, _SAME_SHAPE * height)


def whole_sphere(width: int, height: int) -> EquirectangularCamera:
    """Return the camera of a panorama of the whole sphere.

    Raises:
        CameraError: if the picture is not twice as wide as high.
    """
    if not is_whole_sphere(width, height):
        raise CameraError(
            f"the picture has {width} x {height} pixels, a panorama of the whole sphere is twice as wide as high; give "
            'a camera JSON with {"model": "equirectangular"} and a window'
        )
    return EquirectangularCamera(width, height)


def looks_like_panorama(pixels: NDArray[Any]) -> bool:
    """Return whether a picture looks like a whole equirectangular panorama.

    It is twice as wide as high, its left and right borders continue each other, and its top row, which shows a single
    direction, varies less than its middle. An ordinary picture of this shape fails by its borders.

    Args:
        pixels: (H, W) or (H, W, 3), of any type.
    """
    height, width = pixels.shape[:2]
    if width < 16 or not is_whole_sphere(width, height):
        return False
    rows = slice(height // 8, height - height // 8)
    columns = pixels[rows][:, [0, 1, -2, -1]].astype(np.float64).reshape(rows.stop - rows.start, 4, -1)
    seam = float(np.abs(columns[:, 0] - columns[:, 3]).mean())
    beside = float((np.abs(columns[:, 0] - columns[:, 1]).mean() + np.abs(columns[:, 2] - columns[:, 3]).mean()) / 2)
    if seam > _SEAM_OF_STEP * beside + _MIN_SEAM:
        return False
    top, middle = (float(pixels[row].astype(np.float64).std(axis=0).mean()) for row in (0, height // 2))
    return top < middle


def _fields(xmp: bytes) -> dict[str, str] | None:
    """Return the fields of the panorama's namespace by name; None if there are none.

    They are found by expression rather than by an XML parser: packets are cut, padded and repeated by the programs that
    edit them, and may be hostile.
    """
    packet = xmp[:_LARGEST_XMP]
    if b"\0" in packet[:64]:
        packet = packet.replace(b"\0", b"")  # UTF-16
    found = _PREFIX.search(packet)
    if found is None:
        return None
    prefix = re.escape(found[1])
    written = re.compile(
        prefix
        + rb":([A-Za-z]{1,60})\s*(?:=\s*(?:\"([^\"<]{0,100})\"|'([^'<]{0,100})')|(?:\s[^<>]{0,100})?>([^<]{0,100})<)"
    )
    fields: dict[str, str] = {}
    for match in written.finditer(packet):
        value = next((part for part in match.groups()[1:] if part is not None), b"")
        fields.setdefault(match[1].decode("ascii"), value.decode("utf-8", "replace").strip())
    known = {"ProjectionType", *_SIZES.values()}
    return fields if known & fields.keys() else None


def _pixels(text: str | None) -> float | None:
    """Return a stated number of pixels; None where it is absent, NaN where it is none."""
    if text is None:
        return None
    try:
        value = float(text)
    except ValueError:
        return math.nan
    return value if abs(value) <= _MAX_PIXELS else math.nan


def _window(stated: dict[str, float | None], width: int, height: int) -> tuple[float, float, float, float]:
    full_width, full_height = stated["full_width"] or 0.0, stated["full_height"] or 0.0
    crop = (stated["width"], stated["height"], stated["left"], stated["top"])
    if crop == (None,) * 4 and is_whole_sphere(width, height):
        crop = (full_width, full_height, 0.0, 0.0)
    if None in crop[:2]:
        crop = (float(width), float(height), *crop[2:])
    crop_width, crop_height, left, top = (0.0 if value is None else value for value in crop)
    said = (
        f"its XMP places {crop_width:g} x {crop_height:g} pixels at {left:g}, {top:g} of a panorama of "
        f"{full_width:g} x {full_height:g}"
    )
    give = "give a camera JSON with model equirectangular and a window"
    numbers = (full_width, full_height, crop_width, crop_height, left, top)
    if not all(map(math.isfinite, numbers)) or min(numbers[:4]) < 1 or min(left, top) < 0:
        raise CameraError(f"{said}, which is impossible; {give}")
    if not is_whole_sphere(round(full_width), round(full_height)):
        raise CameraError(f"{said}, which is not twice as wide as high and so not a whole sphere; {give}")
    if crop_width > full_width or top + crop_height > full_height * (1 + 1e-9):
        raise CameraError(f"{said}, which does not fit; {give}")
    if abs(crop_width / crop_height * height / width - 1) > max(_SAME_SHAPE, 2 / min(width, height)):
        raise CameraError(f"{said}, but the picture has {width} x {height}: it was cropped since; {give}")
    lon0, lat_top = left / full_width * 360 - 180, 90 - top / full_height * 180
    return lon0, lat_top, lon0 + crop_width / full_width * 360, lat_top - crop_height / full_height * 180
