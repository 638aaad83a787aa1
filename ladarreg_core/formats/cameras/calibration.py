"""Cameras stated by the fields of a calibration in YAML, XML or JSON: OpenCV, ROS, ORB-SLAM, camodocal and others.

The intrinsics are a camera matrix, four numbers, or fields of their own (`fx`, `fy`, `cx`, `cy`); the distortion is a
list or fields of their own (`k1`, `p1`, ...). Pixels: all count from (0, 0) at the centre of the top-left pixel, as
ladarreg does.

Source: OpenCV, `cv::FileStorage` and the samples that write it; ROS, `sensor_msgs/CameraInfo`; ORB-SLAM3, "Calibration
tutorial"; camodocal, `writeParametersToYamlFile`; direct_visual_lidar_calibration, `calib.json`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ladarreg_core.camera import CameraModel
from ladarreg_core.errors import CameraError, FormatError
from ladarreg_core.formats.cameras.camera_in_file import (
    FileCamera,
    Lens,
    lens_camera,
    lens_of,
    naming,
    numbers_of,
    picture_size,
    refuse_model,
)
from ladarreg_core.formats.cameras.fields import CameraFields, read_fields
from ladarreg_core.formats.parsing.json_file import number, whole_number
from ladarreg_core.formats.parsing.untrusted import one_line

_MATRIX = ("cameramatrix", "k", "intrinsicmatrix", "intrinsics", "mtx", "m")
_DISTORTION = ("distortioncoefficients", "distcoeffs", "distortioncoeffs", "distcoefs", "distortion", "dist", "d")
_SINGLE = (("fx", "fu", "mu"), ("fy", "fv", "mv"), ("cx", "ppx", "u0"), ("cy", "ppy", "v0"))
_TERMS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4")  # OpenCV's order
_WIDTH, _HEIGHT = ("imagewidth", "width", "cols"), ("imageheight", "height", "rows")
_SIZE = ("imagesize", "size", "resolution")
_MODEL = ("distortionmodel", "distortiontype", "cameramodel", "model", "modeltype", "cameratype", "projection",
          "projectionmodel", "projectiontype", "lens", "lensmodel", "lenstype")  # fmt: skip
_SIDES = ("1", "2", "left", "right", "l", "r")
_SKEW = 1e-6
_FLAT = re.compile(rb"(^|\n)[ \t]*(\"?Camera\d?\.)?(fx|intrinsics|projection_parameters)\"?[ \t]*:")


def sniff_calibration(head: bytes, file: Path) -> bool:
    """Return whether a file begins like a calibration in YAML or OpenCV's XML."""
    start = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    if start.startswith(b"{"):
        return False  # JSON is recognised by its fields
    if start.startswith(b"<"):
        return b"<opencv_storage" in head
    words = (b"camera_matrix", b"image_width", b"distortion_model", b"cameraMatrix")
    return start.startswith(b"%YAML") or any(word in head for word in words) or _FLAT.search(head) is not None


def is_calibration(fields: Mapping[str, Any]) -> bool:
    """Return whether the fields of a JSON file state the intrinsics of a camera, or name a camera matrix."""
    known = CameraFields(fields)
    named = any("cameramatrix" in str(key).lower().replace("_", "") for key in fields)  # also of other cameras
    return named or "K" in fields or any(_has_intrinsics(known, side) for side in ("", *_SIDES))


def read_calibration(path: Path) -> tuple[FileCamera, ...]:
    """Return the cameras of a calibration; stereo pairs have two (`M1` and `M2`).

    Raises:
        FormatError: if fields are missing.
        CameraError: if their values are invalid or the lens model is unknown.
    """
    return cameras_of_calibration(read_fields(path))


def cameras_of_calibration(fields: Mapping[str, Any]) -> tuple[FileCamera, ...]:
    """Return the cameras of a calibration's fields, as `read_calibration`; notes name the fields that were not used."""
    known = CameraFields(fields)
    sides = [side for side in ("", *_SIDES) if _has_intrinsics(known, side)]
    if not sides:
        names = ", ".join(one_line(name, 20) for name in list(fields)[:5]) or "nothing"
        raise FormatError(f"it contains {names} but neither fx, fy, cx, cy nor a camera_matrix; give a camera file")
    cameras = [_camera_of(known, side) for side in (sides[:1] if sides[0] == "" else sides)]
    notes = known.notes_on_the_rest()
    return tuple(FileCamera(camera=camera, name=name, notes=notes) for camera, name in cameras)


def _has_intrinsics(known: CameraFields, side: str) -> bool:
    matrix = known.peek([f"{name}{side}" for name in _MATRIX])
    return isinstance(matrix, list | Mapping) or known.peek(_single_names(_SINGLE[0] + _SINGLE[1], side)) is not None


def _single_names(names: Sequence[str], side: str) -> list[str]:
    """Return the spellings of a single number: `Camera.fx`, and `fx` where the file has one camera."""
    return [*(names if not side else ()), *(f"camera{side}{name}" for name in names)]


def _camera_of(known: CameraFields, side: str) -> tuple[CameraModel, str]:
    """Return a camera and its name; `side` is how its fields end in the file of a stereo pair."""

    def field(names: tuple[str, ...]) -> Any:
        own = known.take([f"{name}{side}" for name in names] + _single_names(names, side))
        return own if own is not None or not side or names in (_MATRIX, _DISTORTION) else known.take(
            [*names, *(f"camera{name}" for name in names)]
        )  # fmt: skip

    with naming(side and f"camera {side}"):
        lens = _lens_of(known, field(_MODEL))
        matrix = field(_MATRIX)
        fx, fy, cx, cy = _four_of(matrix) if matrix is not None else _single_numbers(known, side)
        width, height = _size(field(_WIDTH), field(_HEIGHT), field(_SIZE)) or _size_of_picture(known, cx, cy)
        camera = lens_camera(lens, width, height, (fx, fy, cx, cy), _terms_of(known, field(_DISTORTION), lens, side))
        return camera, side or str(known.take(["cameraname"]) or "")


def _four_of(matrix: Any) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy: four numbers, or from a camera matrix, by rows or by columns (Open3D, MATLAB)."""
    K = numbers_of(matrix, "the camera matrix")
    if len(K) == 4:
        return K[0], K[1], K[2], K[3]
    if len(K) != 9:
        raise FormatError(f"the camera matrix has {len(K)} numbers; it must have 9 (3 x 3), or 4 (fx, fy, cx, cy)")
    if K[2] == K[5] == 0 and K[6] > 0 and K[7] > 0:
        K = [K[k] for k in (0, 3, 6, 1, 4, 7, 2, 5, 8)]
    fx, skew, cx, zero, fy, cy, *last = K
    if last != [0, 0, 1] or zero != 0 or abs(skew) > _SKEW * abs(fx):
        raise CameraError("the camera matrix is not [fx 0 cx; 0 fy cy; 0 0 1]; cameras with skew are not supported")
    return fx, fy, cx, cy


def _single_numbers(known: CameraFields, side: str) -> tuple[float, float, float, float]:
    fx, fy, cx, cy = (_single(known, _single_names(names, side), names[0]) for names in _SINGLE)
    return fx, fy, cx, cy


def _single(known: CameraFields, names: Sequence[str], what: str) -> float:
    """Return one number; errors name it as the file does."""
    called = known.called(names) or what
    return number({called: known.take(names)}, called)


def _terms_of(known: CameraFields, listed: Any, lens: Lens, side: str) -> list[float]:
    """Return the distortion, a list or fields of their own, in OpenCV's order; empty: none."""
    if lens == "fisheye" and known.peek(_single_names(["mu"], side)) is not None:
        flat: tuple[str, ...] = ("k2", "k3", "k4", "k5")  # camodocal's names of the four terms
    else:
        flat = ("k1", "k2", "k3", "k4") if lens == "fisheye" else _TERMS
    spelled = {name: _single_names([name], side) for name in _TERMS}
    given = {  # stereo pairs have matrices P1 and K1
        name: names for name, names in spelled.items() if not isinstance(known.peek(names), list | Mapping | None)
    }
    if listed is not None:
        if given:
            raise FormatError(
                f"it states its distortion twice, as a list and as {known.called(next(iter(given.values())))!r}; "
                "keep one of them"
            )
        return numbers_of(listed, "the distortion")
    if not given:
        return []
    values = {name: _single(known, names, name) for name, names in given.items()}
    if lens == "fisheye":
        if set(values) != set(flat):
            raise FormatError(
                f"it is a fisheye with {', '.join(values)}, which could be a pinhole camera's; a fisheye has "
                f"{', '.join(flat)}: state all four, or the list 'distortion'"
            )
        return [values[name] for name in flat]
    last = max(_TERMS.index(name) for name in values) + 1
    count = next(each for each in (4, 5, 8, 12) if each >= last)
    return [values.get(name, 0.0) for name in _TERMS[:count]]


def _lens_of(known: CameraFields, model: Any) -> Lens:
    """Return the lens that the fields name: OpenCV's calibration sample marks a fisheye by `fisheye_model: 1`."""
    if xi := known.take(("xi", "xi1")):
        refuse_model(f"omnidirectional (xi = {one_line(xi, 20)})")
    lens = lens_of(model) if isinstance(model, str) or model is None else refuse_model(model)
    marks = [known.take([name]) for name in ("fisheyemodel", "fisheye", "isfisheye", "usefisheye")]
    marked = any(map(_is_true, marks))
    if marked and isinstance(model, str) and lens == "pinhole":
        raise CameraError(
            f"it names the model {one_line(model, 30)!r} and says that it is a fisheye; correct one of them"
        )
    return "fisheye" if marked else lens


def _is_true(value: Any) -> bool:
    return value is True or (isinstance(value, int | float) and value != 0) or str(value).casefold() in ("true", "yes")


def _size(width: Any, height: Any, size: Any) -> tuple[int, int] | None:
    if (width is None or height is None) and size is not None:
        text = re.findall(r"[-+.\w]+", size) if isinstance(size, str) else None
        pair = numbers_of([float(word) for word in text] if text else size, "the image size")
        if len(pair) == 2:
            width, height = pair
    if width is None and height is None:
        return None
    if width is None or height is None:  # a file that lost one of them is damaged
        raise FormatError("the image size is missing; add image_width and image_height")
    sides = {"image_width": width, "image_height": height}
    return whole_number(sides, "image_width"), whole_number(sides, "image_height")


def _size_of_picture(known: CameraFields, cx: float, cy: float) -> tuple[int, int]:
    """Return the photograph's size, the way round that has the principal point nearer the middle: EXIF may turn it."""
    sides = picture_size.get()
    if sides is None:
        raise FormatError(
            "the image size is missing; add image_width and image_height, or give the photograph with the camera"
        )
    width, height = min(sides, sides[::-1], key=lambda each: abs(cx / each[0] - 0.5) + abs(cy / each[1] - 0.5))
    known.note(f"the camera file states no image size; the photograph's was taken, {width} x {height} px")
    return width, height
