"""Calibrations of OpenCV (YAML, XML, JSON storage) and of ROS (`camera_info`): a camera matrix and its distortion.

Pixels: both count from (0, 0) at the centre of the top-left pixel, as ladarreg does.

Source: OpenCV, `cv::FileStorage` and the samples that write it; ROS, `sensor_msgs/CameraInfo`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ladarreg_core.errors import CameraError, FormatError
from ladarreg_core.formats.camera_fields import first_of, plain_names, read_fields
from ladarreg_core.formats.camera_in_file import (
    FileCamera,
    Lens,
    lens_camera,
    lens_of,
    naming,
    numbers_of,
    refuse_model,
)
from ladarreg_core.formats.json_file import whole_number
from ladarreg_core.formats.untrusted import one_line

_MATRIX = ("cameramatrix", "k", "intrinsicmatrix", "intrinsics", "mtx", "m")
_DISTORTION = ("distortioncoefficients", "distcoeffs", "distortioncoeffs", "distcoefs", "distortion", "dist", "d")
_WIDTH, _HEIGHT = ("imagewidth", "width", "cols"), ("imageheight", "height", "rows")
_SIZE = ("imagesize", "size", "resolution")
_MODEL = ("distortionmodel", "distortiontype", "cameramodel", "model", "modeltype", "cameratype", "projection",
          "projectionmodel", "projectiontype", "lens", "lensmodel", "lenstype")  # fmt: skip
_SIDES = ("1", "2", "left", "right", "l", "r")
_SKEW = 1e-6


def sniff_calibration(head: bytes, file: Path) -> bool:
    """Return whether a file begins like a calibration of OpenCV or ROS."""
    start = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    if start.startswith(b"{"):
        return False  # JSON is recognised by its fields
    if start.startswith(b"<"):
        return b"<opencv_storage" in head
    words = (b"camera_matrix", b"image_width", b"distortion_model", b"cameraMatrix")
    return start.startswith(b"%YAML") or any(word in head for word in words)


def read_calibration(path: Path) -> tuple[FileCamera, ...]:
    """Return the cameras of a calibration; stereo pairs have two (`M1` and `M2`).

    Raises:
        FormatError: if fields are missing.
        CameraError: if their values are invalid or the lens model is unknown.
    """
    return cameras_of_calibration(read_fields(path))


def cameras_of_calibration(fields: Mapping[str, Any]) -> tuple[FileCamera, ...]:
    """Return the cameras of a calibration's fields; see `read_calibration`."""
    by_name = plain_names(fields)
    if first_of(by_name, _MATRIX) is None:
        pair = [side for side in _SIDES if first_of(by_name, [f"{name}{side}" for name in _MATRIX]) is not None]
        if not pair:
            names = ", ".join(one_line(name, 20) for name in list(fields)[:5]) or "nothing"
            raise FormatError(f"it contains {names} but neither fx, fy, cx, cy nor a camera_matrix; give a camera file")
        return tuple(_camera_of(by_name, side) for side in pair)
    return (_camera_of(by_name, ""),)


def _camera_of(by_name: Mapping[str, Any], side: str) -> FileCamera:
    def field(names: tuple[str, ...]) -> Any:
        own = first_of(by_name, [f"{name}{side}" for name in names])
        return own if own is not None or names in (_MATRIX, _DISTORTION) else first_of(by_name, names)

    with naming(side and f"camera {side}"):
        lens = _lens_of(by_name, field(_MODEL))
        K = numbers_of(field(_MATRIX), "the camera matrix")
        if len(K) != 9:
            raise FormatError(f"the camera matrix has {len(K)} numbers; it must have 9 (3 x 3)")
        fx, skew, cx, zero, fy, cy, *last = K
        if last != [0, 0, 1] or zero != 0 or abs(skew) > _SKEW * abs(fx):
            raise CameraError("the camera matrix is not [fx 0 cx; 0 fy cy; 0 0 1]; cameras with skew are not supported")
        width, height = _size(field(_WIDTH), field(_HEIGHT), field(_SIZE))
        raw = field(_DISTORTION)
        terms = numbers_of(raw, "the distortion") if raw is not None else []
        camera = lens_camera(lens, width, height, (fx, fy, cx, cy), terms)
        return FileCamera(camera=camera, name=side or str(by_name.get("cameraname") or ""))


def _lens_of(by_name: Mapping[str, Any], model: Any) -> Lens:
    """Return the lens that the fields name: OpenCV's calibration sample marks a fisheye by `fisheye_model: 1`."""
    if xi := first_of(by_name, ("xi", "xi1")):
        refuse_model(f"omnidirectional (xi = {one_line(xi, 20)})")
    lens = lens_of(model) if isinstance(model, str) or model is None else refuse_model(model)
    marked = any(_is_true(by_name.get(name)) for name in ("fisheyemodel", "fisheye", "isfisheye", "usefisheye"))
    if marked and isinstance(model, str) and lens == "pinhole":
        raise CameraError(
            f"it names the model {one_line(model, 30)!r} and says that it is a fisheye; correct one of them"
        )
    return "fisheye" if marked else lens


def _is_true(value: Any) -> bool:
    return value is True or (isinstance(value, int | float) and value != 0) or str(value).casefold() in ("true", "yes")


def _size(width: Any, height: Any, size: Any) -> tuple[int, int]:
    if (width is None or height is None) and size is not None:
        text = re.findall(r"[-+.\w]+", size) if isinstance(size, str) else None
        pair = numbers_of([float(word) for word in text] if text else size, "the image size")
        if len(pair) == 2:
            width, height = pair
    if width is None or height is None:
        raise FormatError("the image size is missing; add image_width and image_height")
    sides = {"image_width": width, "image_height": height}
    return whole_number(sides, "image_width"), whole_number(sides, "image_height")
