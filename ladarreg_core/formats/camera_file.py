"""Camera files: ladarreg's JSON, OpenCV's YAML or JSON storage, and ROS camera_info YAML."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ladarreg_core.camera import Camera
from ladarreg_core.errors import CameraError, FormatError
from ladarreg_core.formats.json_file import number, read_json_object, whole_number, write_json
from ladarreg_core.formats.opencv_yaml import parse_yaml
from ladarreg_core.formats.untrusted import PathLike, one_line, reading

_LARGEST_BYTES = 1_000_000
_MATRIX = ("cameramatrix", "k", "intrinsicmatrix", "intrinsics", "mtx", "m1", "m")
_DISTORTION = ("distortioncoefficients", "distcoeffs", "distortioncoeffs", "distcoefs", "distortion", "dist", "d", "d1")
_WIDTH, _HEIGHT = ("imagewidth", "width", "cols"), ("imageheight", "height", "rows")
_SIZE = ("imagesize", "size", "resolution")
_PINHOLE_MODELS = ("", "plumb_bob", "rational_polynomial", "radtan", "opencv", "brown", "pinhole", "none")


def read_camera(path: PathLike) -> Camera:
    """Read a camera, its format recognised by content.

    Raises:
        FormatError: if it is not a camera file.
        CameraError: if its parameters are invalid.
    """
    with reading(path) as file:
        size = file.stat().st_size
        if size > _LARGEST_BYTES:
            raise FormatError(
                f"it has {size:,} bytes; a camera file has at most {_LARGEST_BYTES:,}: give the right file"
            )
        with open(file, "rb") as stream:
            start = stream.read(256).removeprefix(b"\xef\xbb\xbf").lstrip()
        if start.startswith(b"{"):
            return camera_from_fields(read_json_object(file, "a camera file"))
        if start.startswith(b"<"):
            raise FormatError(
                "it is XML; a camera is read from JSON, OpenCV YAML or ROS camera_info YAML: save as .yml"
            )
        try:
            text = file.read_text(encoding="utf-8-sig")
        except UnicodeDecodeError:
            raise FormatError("it is not text; a camera is JSON, OpenCV YAML or ROS camera_info YAML") from None
        return camera_from_fields(parse_yaml(text))


def write_camera(path: PathLike, camera: Camera) -> None:
    """Write a camera as JSON.

    Raises:
        ExportError: if the file cannot be written.
    """
    write_json(path, camera_fields(camera))


def camera_fields(camera: Camera) -> dict[str, Any]:
    """Return the fields of a camera's JSON."""
    return camera.as_fields()


def camera_from_fields(fields: Mapping[str, Any]) -> Camera:
    """Return the camera described by the fields of a file.

    Args:
        fields: those of ladarreg (`fx`, ...) or of a calibration tool (`camera_matrix`, `K`, ..., in any case).

    Raises:
        FormatError: if fields are missing.
        CameraError: if their values are invalid.
    """
    if "fx" in fields or "fy" in fields:
        return _camera_from_own_fields(fields)
    if isinstance(fields.get("camera"), Mapping):
        return camera_from_fields(fields["camera"])
    by_name = {"".join(c for c in str(key).lower() if c.isalnum()): value for key, value in fields.items()}
    matrix = _first(by_name, _MATRIX)
    if matrix is None:
        raise FormatError(
            f"it contains {_first_names(fields)} but neither fx, fy, cx, cy nor a camera_matrix; give a camera file"
        )
    return _camera_from_tool_fields(by_name, _numbers(matrix, "the camera matrix"))


def _camera_from_own_fields(fields: Mapping[str, Any]) -> Camera:
    terms = fields.get("distortion", [])
    if not isinstance(terms, list):
        raise FormatError(f"the field 'distortion' is {one_line(repr(terms), 60)}; it must be a list of numbers")
    return Camera(
        width=whole_number(fields, "width"),
        height=whole_number(fields, "height"),
        fx=number(fields, "fx"),
        fy=number(fields, "fy"),
        cx=number(fields, "cx"),
        cy=number(fields, "cy"),
        distortion=tuple(_numbers(terms, "the distortion")),
    )


def _camera_from_tool_fields(by_name: Mapping[str, Any], K: list[float]) -> Camera:
    model = str(by_name.get("distortionmodel") or "").lower()
    if model not in _PINHOLE_MODELS:
        raise CameraError(
            f"the distortion model is {one_line(model, 40)!r}; only OpenCV's pinhole models with 4, 5 or 8 terms are "
            "read: calibrate with plumb_bob or rational_polynomial"
        )
    if len(K) != 9:
        raise FormatError(f"the camera matrix has {len(K)} numbers; it must have 9 (3 x 3)")
    fx, skew, cx, zero, fy, cy, *last = K
    if last != [0, 0, 1] or zero != 0 or abs(skew) > 1e-6 * abs(fx):
        raise CameraError("the camera matrix is not [fx 0 cx; 0 fy cy; 0 0 1]; cameras with skew are not supported")
    width, height = _first(by_name, _WIDTH), _first(by_name, _HEIGHT)
    size = _first(by_name, _SIZE)
    if (width is None or height is None) and size is not None:
        pair = _numbers(size, "the image size")
        if len(pair) == 2:
            width, height = pair
    if width is None or height is None:
        raise FormatError("the image size is missing; add image_width and image_height")
    sides = {"image_width": width, "image_height": height}
    raw = _first(by_name, _DISTORTION)
    terms = _numbers(raw, "the distortion") if raw is not None else []
    if len(terms) in (12, 14):
        if any(terms[8:]):
            raise CameraError(
                f"the distortion has {len(terms)} terms; thin-prism and tilt terms are not supported: use 8"
            )
        terms = terms[:8]
    return Camera(whole_number(sides, "image_width"), whole_number(sides, "image_height"), fx, fy, cx, cy, tuple(terms))


def _first(by_name: Mapping[str, Any], names: Sequence[str]) -> Any:
    return next((by_name[name] for name in names if by_name.get(name) is not None), None)


def _numbers(value: Any, what: str) -> list[float]:
    """Return the numbers in a list, a list of lists, or an OpenCV matrix with its `data`."""
    if isinstance(value, Mapping):
        data = value.get("data")
        numbers = _numbers(data if data is not None else [], what)
        rows, columns = value.get("rows"), value.get("cols")
        if isinstance(rows, int) and isinstance(columns, int) and rows * columns != len(numbers):
            raise FormatError(f"{what} has {len(numbers)} numbers; its rows and cols say {rows} x {columns}")
        return numbers
    if not isinstance(value, list):
        raise FormatError(f"{what} is {one_line(repr(value), 60)}; it must be a list of numbers")
    if value and all(isinstance(item, list) for item in value):
        value = [item for row in value for item in row]
    return [number({what: item}, what) for item in value]


def _first_names(fields: Mapping[str, Any]) -> str:
    names = ", ".join(one_line(name, 20) for name in list(fields)[:5])
    return names or "nothing"


def sniff_camera_yaml(head: bytes) -> bool:
    """Return whether the first bytes look like a calibration in YAML."""
    return head.lstrip().startswith(b"%YAML") or any(
        word in head for word in (b"camera_matrix", b"image_width", b"distortion_model", b"cameraMatrix")
    )


def describe_camera(camera: Camera) -> dict[str, Any]:
    """Return a camera's parameters, formatted for display."""
    return {
        "size": f"{camera.width} x {camera.height} px",
        "focal_px": f"{camera.fx:.2f}, {camera.fy:.2f}",
        "principal_point_px": f"{camera.cx:.2f}, {camera.cy:.2f}",
        "distortion": " ".join(f"{k:.6g}" for k in camera.distortion) or "none",
    }
