"""transforms.json of nerfstudio and its relatives: intrinsics for all frames or for each, and camera-to-world poses.

Pixels: the centre of the first pixel is (.5, .5), so principal points are ours + .5. The camera's axes are OpenGL's:
x right, y up, looking along -z. `applied_transform` and `applied_scale` say how the world was changed, and are undone.

Source: nerfstudio's documentation, "Data conventions"; its `camera_utils` for the distortion.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import CameraModel, EquirectangularCamera
from ladarreg_core.camera.equirectangular import FULL_WINDOW
from ladarreg_core.errors import CameraError, FormatError, LadarregError
from ladarreg_core.formats.cameras.camera_in_file import (
    FileCamera,
    equirectangular_camera,
    lens_camera,
    naming,
    numbers_of,
    refuse_model,
)
from ladarreg_core.formats.cameras.fields import notes_on_unused
from ladarreg_core.formats.cameras.refit import refitted
from ladarreg_core.formats.parsing.json_file import number, read_json_object, whole_number
from ladarreg_core.formats.parsing.untrusted import one_line
from ladarreg_core.frames import Rigid

_MAX_FRAMES = 50_000
_MAX_KINDS = 2_000
_INTRINSICS = ("camera_model", "w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2",
               "camera_angle_x", "camera_angle_y", "is_fisheye")  # fmt: skip
_USED = (*_INTRINSICS, "frames", "applied_transform", "applied_scale", "file_path", "transform_matrix")
_PINHOLES = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "PERSPECTIVE")
_OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def is_nerfstudio(fields: Mapping[str, Any]) -> bool:
    """Return whether the fields of a JSON file are those of transforms.json."""
    frames = fields.get("frames")
    if isinstance(frames, list):
        return any(isinstance(frame, Mapping) and "transform_matrix" in frame for frame in frames[:3])
    return "fl_x" in fields


def read_nerfstudio(path: Path) -> tuple[FileCamera, ...]:
    """Return the cameras of transforms.json; frames with the same intrinsics share one.

    Raises:
        FormatError: if fields are missing or wrong.
        CameraError: if a model is not read, or its parameters are invalid.
    """
    fields = read_json_object(path, "transforms.json")
    frames = fields.get("frames") or []
    if not isinstance(frames, list) or len(frames) > _MAX_FRAMES:
        raise FormatError(f"'frames' is not a list of at most {_MAX_FRAMES:,} frames; export it again")
    shared = {name: fields[name] for name in _INTRINSICS if fields.get(name) is not None}
    undone = _undone(fields)
    first = frames[0] if frames and isinstance(frames[0], Mapping) else {}
    unused = notes_on_unused({name: value for name, value in {**first, **fields}.items() if name not in _USED})
    kinds: dict[str, tuple[dict[str, Any], dict[str, Rigid | None]]] = {}
    for frame in frames:
        if not isinstance(frame, Mapping):
            raise FormatError(f"a frame is {one_line(repr(frame), 40)}; it must be an object in braces")
        own = {name: frame[name] for name in _INTRINSICS if frame.get(name) is not None}
        entry = kinds.setdefault(repr(sorted(own.items(), key=str)), ({**shared, **own}, {}))
        if len(kinds) > _MAX_KINDS:
            raise FormatError(f"its frames have more than {_MAX_KINDS:,} different intrinsics; split the file")
        entry[1][str(frame.get("file_path") or f"frame {len(entry[1])}")] = _pose_of(frame, undone)
    if not kinds:
        kinds["all"] = (shared, {})
    found = (_camera_of(k, *entry, several=len(kinds) > 1) for k, entry in enumerate(kinds.values()))
    return tuple(replace(each, notes=each.notes + unused) for each in found)


def _camera_of(
    index: int, intrinsics: Mapping[str, Any], frames: Mapping[str, Rigid | None], *, several: bool
) -> FileCamera:
    name = ""
    if several:
        name = next(iter(frames)) if len(frames) == 1 else f"camera {index} ({len(frames)} pictures)"
    with naming(name):
        camera, notes = _camera_and_notes(intrinsics)
    poses = {frame: pose for frame, pose in frames.items() if pose is not None}
    return FileCamera(camera=camera, name=name, pictures=tuple(frames), poses=poses, notes=notes)


def _camera_and_notes(given: Mapping[str, Any]) -> tuple[CameraModel, tuple[str, ...]]:
    model = str(given.get("camera_model") or ("OPENCV_FISHEYE" if given.get("is_fisheye") is True else "OPENCV"))
    if given.get("w") is None or given.get("h") is None:
        raise FormatError("the size of the photographs, 'w' and 'h', is missing; add both to the file")
    width, height = whole_number(given, "w"), whole_number(given, "h")
    if model.upper() == "EQUIRECTANGULAR":
        return _panorama(given, width, height), ()
    fx, fy = _focal(given, "fl_x", "camera_angle_x", width), _focal(given, "fl_y", "camera_angle_y", height)
    fx, fy = fx or fy, fy or fx
    if fx is None or fy is None:
        raise FormatError("the focal length 'fl_x' is missing; add it in pixels")
    matrix = (fx, fy, number(given, "cx", width / 2) - 0.5, number(given, "cy", height / 2) - 0.5)
    k1, k2, k3, k4 = (number(given, f"k{k}", 0.0) for k in (1, 2, 3, 4))
    p1, p2 = number(given, "p1", 0.0), number(given, "p2", 0.0)
    if model.upper() in ("OPENCV_FISHEYE", "FISHEYE"):
        return lens_camera("fisheye", width, height, matrix, (k1, k2, k3, k4)), ()
    if model.upper() not in _PINHOLES:
        refuse_model(model, "export the photographs undistorted")
    if not k4:
        return lens_camera("pinhole", width, height, matrix, (k1, k2, p1, p2, k3) if k3 else (k1, k2, p1, p2)), ()

    def project(points: NDArray[np.float64]) -> NDArray[np.float64]:
        x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
        s = x * x + y * y
        radial = 1 + s * (k1 + s * (k2 + s * (k3 + s * k4)))
        xd = x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x)
        yd = y * radial + p1 * (s + 2 * y * y) + 2 * p2 * x * y
        return np.stack([xd * matrix[0] + matrix[2], yd * matrix[1] + matrix[3]], axis=-1)

    camera, note = refitted(project, "pinhole", width, height, matrix, f"k4 = {k4:g} (r^8)")
    return camera, (note,)


def _panorama(given: Mapping[str, Any], width: int, height: int) -> CameraModel:
    """Return a whole sphere or, if the focal lengths (pixels per half turn) and centre say so, a window of one."""
    if all(given.get(name) is not None for name in ("fl_x", "fl_y", "cx", "cy")):
        fx, fy, cx, cy = (number(given, name) for name in ("fl_x", "fl_y", "cx", "cy"))
        if fx > 0 and fy > 0:
            left, top, right, bottom = -180 * cx / fx, 180 * cy / fy, 180 * (width - cx) / fx, 180 * (cy - height) / fy
            is_whole = np.allclose((left, top, right, bottom), FULL_WINDOW, atol=1e-6)
            try:
                return EquirectangularCamera(width, height, None if is_whole else (left, top, right, bottom))
            except CameraError:  # other programs fill these fields with numbers that mean nothing
                pass
    return equirectangular_camera(width, height)


def _focal(given: Mapping[str, Any], name: str, angle: str, side: int) -> float | None:
    if given.get(name) is not None:
        return number(given, name)
    if given.get(angle) is None:
        return None
    half = number(given, angle) / 2
    if not 0 < half < math.pi / 2:
        raise FormatError(f"the field {angle!r} is {2 * half:g}; it must be an angle of view in rad, below pi")
    return side / 2 / math.tan(half)


def _undone(fields: Mapping[str, Any]) -> tuple[NDArray[np.float64], float]:
    """Return the inverse of `applied_transform` (4, 4), and `applied_scale`."""
    matrix = np.eye(4)
    if fields.get("applied_transform") is not None:
        rows = numbers_of(fields["applied_transform"], "applied_transform")
        if len(rows) not in (12, 16):
            raise FormatError(f"applied_transform has {len(rows)} numbers; it must have 12 (3 x 4)")
        matrix[: len(rows) // 4] = np.reshape(rows, (-1, 4))
    scale = number(fields, "applied_scale", 1.0)
    if not scale > 0 or not abs(float(np.linalg.det(matrix))) > 1e-9:
        raise FormatError("applied_transform or applied_scale cannot be inverted; export the file again")
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64), scale


def _pose_of(frame: Mapping[str, Any], undone: tuple[NDArray[np.float64], float]) -> Rigid | None:
    """Return `camera_from_world` of a frame; None where it has none, or none that is rigid."""
    if frame.get("transform_matrix") is None:
        return None
    numbers = numbers_of(frame["transform_matrix"], "transform_matrix")
    if len(numbers) not in (12, 16):
        raise FormatError(f"a transform_matrix has {len(numbers)} numbers; it must have 16 (4 x 4)")
    world_from_camera = np.eye(4)
    world_from_camera[: len(numbers) // 4] = np.reshape(numbers, (-1, 4))
    inverse, scale = undone
    world_from_camera[:3, 3] /= scale
    try:
        return Rigid.from_matrix(inverse @ world_from_camera @ _OPENCV_FROM_OPENGL).inverse
    except LadarregError:  # the intrinsics are of use without it
        return None
