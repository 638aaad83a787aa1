"""What every E57 that is written says of itself, and nodes of numbers and poses."""

from __future__ import annotations

import time
import uuid
from collections.abc import Mapping
from typing import Any

from ladarreg_core.export.e57.tree import library
from ladarreg_core.export.json import software_document
from ladarreg_core.export.registered_scan import Registered
from ladarreg_core.formats.parsing.untrusted import one_line
from ladarreg_core.frames import Rigid

_PREFIX, _NAMESPACE = "ladarreg", "urn:ladarreg:e57"
LAYERS = f"{_PREFIX}:layers"
"""The element of a scan that says what its layers are, by their names."""
NOTE = f"{_PREFIX}:note"
"""The element of the file that names the photographs, and says which poses were given."""
_GPS_EPOCH_S = 315_964_800  # 1980-01-06 in Unix time
_LEAP_SECONDS = 18  # of GPS time since then
_LONGEST_NAME = 200


def layer_field(name: str) -> str:
    """Return the name that a layer has in the records of points, and in `LAYERS`."""
    return f"{_PREFIX}:{name}"


def declare_note(file: Any) -> None:
    """Declare the namespace of `NOTE` and the layers, unless the file has it already."""
    if not file.extensionsLookupPrefix(_PREFIX, ""):
        file.extensionsAdd(_PREFIX, _NAMESPACE)


def note_of(handed: Registered) -> str:
    """Return where colours and images come from, and which poses were given."""
    software = software_document()
    names = ", ".join(plain(one.photo.name) for one in handed.photos)
    marks = "".join(f"; {plain(mark)}" for mark in handed.marks)
    return f"colours and images by {software['name']} {software['version']} from {names}{marks}"


def software_name() -> str:
    """Return the names and versions of the software that writes a file."""
    software = software_document()
    return f"{software['name']}-{software['version']}-{library().E57_LIBRARY_ID}"


def pose_node(file: Any, pose: Rigid) -> Any:
    """Return the pose of a frame in the coordinates of the file."""
    from scipy.spatial.transform import Rotation

    made = library().StructureNode(file)
    x, y, z, w = Rotation.from_matrix(pose.rotation).as_quat().tolist()
    made.set("rotation", number_nodes(file, {"w": w, "x": x, "y": y, "z": z}))
    made.set("translation", number_nodes(file, dict(zip("xyz", pose.translation.tolist(), strict=True))))
    return made


def number_nodes(file: Any, numbers: Mapping[str, float]) -> Any:
    """Return a structure of numbers, see `set_numbers`."""
    return set_numbers(file, library().StructureNode(file), numbers)


def set_numbers(file: Any, made: Any, numbers: Mapping[str, float]) -> Any:
    """Add numbers to a structure, whole ones as integers and others as doubles."""
    e57 = library()
    for name, value in numbers.items():
        whole = isinstance(value, int)
        made.set(name, e57.IntegerNode(file, value) if whole else e57.FloatNode(file, value))
    return made


def time_node(file: Any) -> Any:
    """Return the present time."""
    made = number_nodes(file, {"dateTimeValue": time.time() - _GPS_EPOCH_S + _LEAP_SECONDS})
    made.set("isAtomicClockReferenced", library().IntegerNode(file, 0))
    return made


def new_guid() -> str:
    """Return a GUID that nothing else has."""
    return f"{{{str(uuid.uuid4()).upper()}}}"


def plain(text: str, longest: int = _LONGEST_NAME) -> str:
    """Return a text without the characters that XML must not contain."""
    return one_line(text, longest)
