"""What is known of a file before it is opened: its kind, and what decides which other files it belongs to."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ladarreg_core.errors import LadarregError
from ladarreg_core.formats.cameras.camera_file import read_cameras
from ladarreg_core.formats.file_info import FileKind, scans_in
from ladarreg_core.formats.parsing.json_file import parsed_once, read_json_object
from ladarreg_core.formats.parsing.untrusted import PathLike
from ladarreg_core.formats.photos.image_file import image_size
from ladarreg_core.formats.registry import recognise
from ladarreg_core.formats.scans.descriptor import named_files

_MAX_SIZES = 100
_MAX_SCANS = 1000
_MAX_PICTURES = 20_000


@dataclass(frozen=True, slots=True)
class FileSurvey:
    """Kind of a file, and how it relates to others."""

    kind: FileKind
    """Kind of content."""
    format: str
    """Name of the file format."""
    names: tuple[str, ...] = ()
    """Files that it names and cannot be read without, relative to its folder."""
    width: int = 0
    """Width of a photograph, or of a camera's pictures, pixels; 0 where it is unknown."""
    height: int = 0
    """Height, likewise."""
    sizes: tuple[tuple[int, int], ...] = ()
    """Sizes of the pictures of all cameras of a camera file, (width, height), pixels."""
    pictures: tuple[str, ...] = ()
    """File names of the photographs that the cameras of a camera file took, where it states them."""
    takes: tuple[str, ...] = ()
    """Names of the options that its reader takes: those of `ScanRequest` for a scan, `temperature_unit` for a
    photograph, `camera_name` for a file of several cameras."""
    scans: tuple[str, ...] = ()
    """Descriptions of the scans of a file that contains several."""


def survey_file(path: PathLike) -> FileSurvey:
    """Survey a file of any format; its name does not matter.

    Raises:
        FormatError: if its format is unknown.
    """
    with parsed_once():
        found = recognise(path)
        file = Path(path)
        try:
            if found.name == "descriptor JSON":
                return FileSurvey(found.kind, found.name, named_files(read_json_object(file, "a scan descriptor")))
            if found.kind == "scan":
                scans = scans_in(file, found.name)
                return FileSurvey(
                    found.kind, found.name, takes=found.takes, scans=scans[:_MAX_SCANS] if len(scans) > 1 else ()
                )
            if found.kind == "photo":
                width, height, _ = image_size(file)
                return FileSurvey(found.kind, found.name, (), width, height, takes=("temperature_unit",))
            if found.kind == "camera":
                cameras = read_cameras(file)
                sizes = tuple(dict.fromkeys(each.camera.size for each in cameras))
                taken = dict.fromkeys(picture for each in cameras for picture in each.pictures)
                return FileSurvey(
                    found.kind,
                    found.name,
                    (),
                    *sizes[0],
                    sizes=sizes[:_MAX_SIZES],
                    pictures=tuple(taken)[:_MAX_PICTURES],
                    takes=("camera_name",) if len(cameras) > 1 else (),
                )
        except LadarregError:  # it is damaged, which its reader says when it is opened
            pass
        return FileSurvey(found.kind, found.name, takes=found.takes)
