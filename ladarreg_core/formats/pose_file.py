"""Pose files: `{"camera_from_scanner": 4 x 4}`; every `registration.json` is one, too."""

from __future__ import annotations

from ladarreg_core.errors import DegenerateGeometryError, FormatError, ShapeError
from ladarreg_core.formats.json_file import number, read_json_object, write_json
from ladarreg_core.formats.untrusted import PathLike, one_line, reading
from ladarreg_core.frames import Rigid

POSE_FIELD = "camera_from_scanner"


def read_pose(path: PathLike, *, field: str = POSE_FIELD) -> Rigid:
    """Read `camera_from_scanner`, or another transform.

    Args:
        path: the file.
        field: name of the transform in the file.

    Raises:
        FormatError: if it is not JSON with that field, or the field is not a rigid transform.
    """
    with reading(path) as file:
        rows = read_json_object(file, "a pose file").get(field)
        if rows is None:
            raise FormatError(f"the field {field!r} is missing; a pose file contains it as 4 rows of 4 numbers")
        if not (isinstance(rows, list) and len(rows) == 4 and all(isinstance(r, list) and len(r) == 4 for r in rows)):
            raise FormatError(f"{field!r} is {one_line(repr(rows), 60)}; it must be 4 rows of 4 numbers")
        matrix = [[number({field: value}, field) for value in row] for row in rows]
        try:
            return Rigid.from_matrix(matrix)
        except (DegenerateGeometryError, ShapeError) as error:
            raise FormatError(f"{field!r} is not a rigid transform: {error}") from error


def write_pose(path: PathLike, camera_from_scanner: Rigid) -> None:
    """Write a pose.

    Raises:
        ExportError: if the file cannot be written.
    """
    write_json(path, {POSE_FIELD: camera_from_scanner.matrix.tolist()})
