"""Pose files: `{"camera_from_scanner": 4 x 4}`, or `camera_from_world`; every `registration.json` is one, too."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ladarreg_core.errors import DegenerateGeometryError, FormatError, ShapeError
from ladarreg_core.formats.cameras.camera_file import read_stated_pose
from ladarreg_core.formats.parsing.json_file import number, parsed_once, read_json_object, write_json
from ladarreg_core.formats.parsing.untrusted import PathLike, one_line, reading
from ladarreg_core.frames import Rigid

POSE_FIELD = "camera_from_scanner"
WORLD_FIELD = "camera_from_world"
GUESS_FIELD = "rejected_guess"
CAMERAS_FIELD = "by_camera"
"""Field of a rig of several cameras with the result of each by its name."""
_OTHER_POSE = "register again, or give another pose"
_SAME_PLACE_M = 1e-4
_SAME_PLACE_RAD = 1e-5


def read_pose(path: PathLike, *, field: str = POSE_FIELD) -> Rigid:
    """Read `camera_from_scanner`, or another transform.

    Args:
        path: the file.
        field: name of the transform in the file.

    Raises:
        FormatError: if it is not JSON with that field, or the field is not a rigid transform.
    """
    with reading(path) as file:
        fields = read_json_object(file, "a pose file")
        rows = fields.get(field)
        if rows is None:
            raise FormatError(_missing(fields, field))
        return _rigid(rows, field)


def _rigid(rows: Any, field: str) -> Rigid:
    """Return the transform of 4 rows of 4 numbers."""
    if not (isinstance(rows, list) and len(rows) == 4 and all(isinstance(r, list) and len(r) == 4 for r in rows)):
        raise FormatError(f"{field!r} is {one_line(repr(rows), 60)}; it must be 4 rows of 4 numbers")
    matrix = [[number({field: value}, field) for value in row] for row in rows]
    try:
        return Rigid.from_matrix(matrix)
    except (DegenerateGeometryError, ShapeError) as error:
        raise FormatError(f"{field!r} is not a rigid transform: {error}") from error


def read_initial_of_rig(path: PathLike) -> Rigid | dict[str, Rigid]:
    """Read the rough pose of a rig's camera, or of each of its cameras by name from the `rig.json` of several.

    Raises:
        FormatError: as `read_pose`; also if it has the poses of several cameras, none of which was accepted.
    """
    with reading(path) as file, parsed_once():
        fields = read_json_object(file, "a pose file")
        cameras = fields.get(CAMERAS_FIELD)
        if not isinstance(cameras, Mapping):
            return read_initial(path, None)
        found = {}
        for name, own in cameras.items():
            if isinstance(own, Mapping) and own.get(POSE_FIELD) is not None:
                found[str(name)] = _rigid(own[POSE_FIELD], POSE_FIELD)
        if not found:
            raise FormatError(f"it has no pose: every camera of its rig was refused; {_OTHER_POSE}")
        return found


def _missing(fields: Mapping[str, Any], field: str) -> str:
    if field == POSE_FIELD and isinstance(fields.get(CAMERAS_FIELD), Mapping):
        names = ", ".join(one_line(name, 40) for name in fields[CAMERAS_FIELD])
        return (
            f"it has the poses of several cameras ({names}); give the file of one of them, NAME.pose.json, which lies "
            "beside it"
        )
    if field == POSE_FIELD and GUESS_FIELD in fields:
        return (
            f"it has no pose: the registration was refused ({POSE_FIELD!r} is null), and its best guess "
            f"({GUESS_FIELD!r}) must not be taken for one; {_OTHER_POSE}"
        )
    return f"the field {field!r} is missing; a pose file contains it as 4 rows of 4 numbers"


def read_initial(path: PathLike, world_from_scanner: Rigid | None, *, picture: str = "") -> Rigid:
    """Read an initial pose for a scan, `camera_from_scanner`, from a pose file that may state it in the world.

    Of a file with both poses, such as a `registration.json`, the pose in the world is used if the file's own
    `world_from_scanner` is another than the scan's: the camera was then registered with another scan of the survey.

    Args:
        path: a file with `camera_from_scanner` or `camera_from_world`.
        world_from_scanner: the scan's; None: not known.
        picture: file name of the photograph, whose pose is read from the files of a reconstruction (nerfstudio's
            transforms.json, COLMAP's cameras beside its images) if its world is the scan's.

    Raises:
        FormatError: as `read_pose`, or if the file states the pose in the world only and the scan's is not known.
    """
    with reading(path) as file, parsed_once():
        stated = read_stated_pose(file, picture) if picture else None
        if stated is not None:
            if world_from_scanner is None:
                raise FormatError(
                    "it states the photograph's pose in its own world, but the scan's file does not say where the "
                    "scanner stands in it; give a scan with its pose (E57, PTX, NPZ), or a pose JSON"
                )
            return stated @ world_from_scanner
        fields = read_json_object(file, "a pose file")
        in_world = fields.get(WORLD_FIELD) is not None
        if in_world and world_from_scanner is not None and fields.get("world_from_scanner") is not None:
            other = read_pose(path, field="world_from_scanner")
            moved = other.distance_to(world_from_scanner) > _SAME_PLACE_M
            if moved or other.angle_to(world_from_scanner) > _SAME_PLACE_RAD:
                return read_pose(path, field=WORLD_FIELD) @ world_from_scanner
        if fields.get(POSE_FIELD) is not None or not in_world:
            return read_pose(path)
        if world_from_scanner is None:
            raise FormatError(
                f"it states the camera's pose in the world ({WORLD_FIELD!r}), but the scan's file does not say where "
                f"the scanner stands in the world; give {POSE_FIELD!r}, or a scan with its pose (E57, PTX, NPZ)"
            )
        return read_pose(path, field=WORLD_FIELD) @ world_from_scanner


def write_pose(path: PathLike, camera_from_scanner: Rigid) -> None:
    """Write a pose.

    Raises:
        ExportError: if the file cannot be written.
    """
    write_json(path, {POSE_FIELD: camera_from_scanner.matrix.tolist()})
