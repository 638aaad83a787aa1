"""Files in: every format in one table, recognised by content."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from ladarreg_core.camera import Camera
    from ladarreg_core.formats.e57_images import ExtractedImage
    from ladarreg_core.formats.untrusted import PathLike
    from ladarreg_core.photo import Photo
    from ladarreg_core.progress import Report
    from ladarreg_core.scan import Scan

FileKind = Literal["scan", "photo", "camera", "pose", "matches"]
_HEAD_BYTES = 4096


@dataclass(frozen=True, slots=True)
class FileFormat:
    """One format that is read."""

    name: str
    """What to call it."""
    kind: FileKind
    """What it holds."""
    sniff: Callable[[bytes, Path], bool]
    """Tells from the first bytes, and where they do not suffice from the file, whether a file is of this format."""
    describe: Callable[[Path], FileInfo]
    """Tells what a file of this format holds."""
    read_scan: Callable[[Path, int, int | None, Report | None], Scan] | None = None
    """Reads it, where it holds a scan: path, scan index, memory that may be used (None: the usual), report."""


@dataclass(frozen=True, kw_only=True)
class FileInfo:
    """What a file holds, for a person; what does not apply is None or empty."""

    file: str
    """Its name."""
    bytes: int
    """Its size."""
    kind: FileKind
    """What it holds."""
    format: str
    """How it is written."""
    size: str | None = None
    """Rows and columns, or width and height."""
    returns: int | None = None
    """Cells with a range."""
    range_m: tuple[float, float] | None = None
    """Nearest and farthest."""
    median_range_m: float | None = None
    intensity: tuple[float, float] | None = None
    """Lowest and highest, in the sensor's unit."""
    step_deg: tuple[float, float] | None = None
    """Angle between rows and between columns."""
    color: bool | None = None
    """Whether the scanner saw colour itself."""
    scans: tuple[str, ...] = ()
    """The scans of a file that can hold several."""
    images: tuple[str, ...] = ()
    """Embedded pictures."""
    camera: Mapping[str, Any] = field(default_factory=dict)
    """Intrinsics."""
    exif: Mapping[str, Any] = field(default_factory=dict)
    """What the camera wrote."""
    pose: Mapping[str, Any] = field(default_factory=dict)
    """A pose in words."""
    matches: str | None = None
    """How many points and lines."""
    notes: tuple[str, ...] = ()
    """What an operator should know."""


def formats() -> tuple[FileFormat, ...]:
    """Return the table of all formats, in the order in which they are tried."""
    from ladarreg_core.formats.registry import FORMATS

    return FORMATS


def recognise(path: PathLike, *, kinds: tuple[FileKind, ...] = ()) -> FileFormat:
    """Return the format of a file, by its content.

    Args:
        path: the file.
        kinds: what it may hold; empty: anything.

    Raises:
        FormatError: if there is no such file, or it is of no known format.
    """
    from ladarreg_core.errors import FormatError
    from ladarreg_core.formats.json_file import parsed_once
    from ladarreg_core.formats.registry import FORMATS, foreign_format
    from ladarreg_core.formats.untrusted import reading

    with reading(path) as file, parsed_once():
        with open(file, "rb") as stream:
            head = stream.read(_HEAD_BYTES)
        found = next((f for f in FORMATS if (not kinds or f.kind in kinds) and f.sniff(head, file)), None)
        if found is None:
            other = next((f for f in FORMATS if f.sniff(head, file)), None)
            what = f"it is a {other.kind} ({other.name})" if other else foreign_format(head)
            wanted = sorted({f"{f.name}" for f in FORMATS if not kinds or f.kind in kinds})
            raise FormatError(f"{what}; a {' or '.join(kinds) or 'file'} is one of {', '.join(wanted)}")
        return found


def read_scan(
    path: PathLike, *, scan_index: int = 0, memory_bytes: int | None = None, report: Report | None = None
) -> Scan:
    """Read a scan, its format recognised by content.

    Args:
        path: an E57, NPZ, PCD or descriptor file.
        scan_index: which scan, in files that hold several.
        memory_bytes: memory that the read may use at its peak, bytes; None: 1 GB, or 64 times the file's size if that
            is more.
        report: receives the progress.

    Raises:
        FormatError: if it is no scan, is damaged, has no intensity, or would need more memory than it may use.
        ShapeError: if its arrays disagree, or there are no returns.
        OptionError: if there is no scan of that index.
    """
    from ladarreg_core.errors import OptionError
    from ladarreg_core.formats.json_file import parsed_once

    with parsed_once():
        found = recognise(path, kinds=("scan",))
        if scan_index != 0 and found.name != "E57":
            raise OptionError(f"scan_index is {scan_index}, but a {found.name} file holds one scan; leave it out")
        assert found.read_scan is not None, "every scan format has a reader"
        return found.read_scan(Path(path), scan_index, memory_bytes, report)


def read_photo(
    path: PathLike,
    *,
    camera: Camera | PathLike | None = None,
    focal_px: float | None = None,
    focal_mm: float | None = None,
    sensor_mm: float | None = None,
    memory_bytes: int | None = None,
) -> Photo:
    """Read a photograph with its camera; see `photo_file.read_photo`."""
    from ladarreg_core.formats import photo_file

    return photo_file.read_photo(
        path,
        camera=camera,
        focal_px=focal_px,
        focal_mm=focal_mm,
        sensor_mm=sensor_mm,
        memory_bytes=memory_bytes,
    )


def describe(path: PathLike) -> FileInfo:
    """Return what a file holds: scan, photograph, camera, pose or matches.

    Raises:
        LadarregError: if it cannot be read.
    """
    from ladarreg_core.formats.json_file import parsed_once

    with parsed_once():
        return recognise(path).describe(Path(path))


def extract_images(path: PathLike, folder: PathLike) -> list[ExtractedImage]:
    """Write the pictures embedded in an E57 file; see `e57_images.extract_images`."""
    from ladarreg_core.formats import e57_images

    return e57_images.extract_images(path, folder)
