"""The table of file formats: their extensions, and how each is recognised, read and described.

This is the only place that knows extensions. Files are recognised by content; an extension is only used to list a
folder without opening every file in it.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from ladarreg_core.errors import FormatError, LadarregError, OptionError
from ladarreg_core.formats.cameras.calibration import is_calibration
from ladarreg_core.formats.cameras.camera_file import CAMERA_FORMATS, CameraFormat
from ladarreg_core.formats.cameras.nerfstudio import is_nerfstudio
from ladarreg_core.formats.documents.pose_file import POSE_FIELD, WORLD_FIELD
from ladarreg_core.formats.e57.header import sniff_e57
from ladarreg_core.formats.e57.reader import read_e57
from ladarreg_core.formats.file_info import (
    FileInfo,
    FileKind,
    describe_bag,
    describe_camera_file,
    describe_e57,
    describe_las,
    describe_matches,
    describe_photo,
    describe_pose,
    describe_ptx,
    scan_describer,
)
from ladarreg_core.formats.packets.capture import sniff_capture
from ladarreg_core.formats.packets.ouster_pcap import read_ouster_pcap
from ladarreg_core.formats.packets.velodyne_pcap import is_velodyne, read_velodyne_pcap
from ladarreg_core.formats.parsing.begun_read import BegunRead
from ladarreg_core.formats.parsing.json_file import looks_like_json, parsed_once, read_json_object
from ladarreg_core.formats.parsing.untrusted import PathLike, reading
from ladarreg_core.formats.photos.image_file import image_format
from ladarreg_core.formats.recordings.recording import sniff_recording
from ladarreg_core.formats.results_info import describe_results
from ladarreg_core.formats.scans.accumulated import read_accumulated
from ladarreg_core.formats.scans.bag import read_bag
from ladarreg_core.formats.scans.descriptor import KINDS as DESCRIPTOR_KINDS
from ladarreg_core.formats.scans.descriptor import read_descriptor
from ladarreg_core.formats.scans.float_bin import read_float_bin, sniff_float_bin
from ladarreg_core.formats.scans.las import read_las
from ladarreg_core.formats.scans.las_header import sniff_las
from ladarreg_core.formats.scans.npz import read_npz, sniff_npz
from ladarreg_core.formats.scans.pcd import read_pcd, sniff_pcd
from ladarreg_core.formats.scans.ply import read_ply, sniff_ply
from ladarreg_core.formats.scans.ptx import read_ptx, sniff_ptx
from ladarreg_core.formats.scans.scan_request import IntensitySource, ScanRequest
from ladarreg_core.formats.scans.text_cloud import read_text_cloud, sniff_pts, sniff_text_cloud
from ladarreg_core.foundations.progress import Report
from ladarreg_core.foundations.source import with_source
from ladarreg_core.scan import Scan

_HEAD_BYTES = 4096
_UNSUPPORTED = (
    (b"\x89HDF", "an HDF5 file"),
    (b"glTF", "a GLB model"),
    (b"%PDF", "a PDF"),
    (b"\x93NUMPY", "a single NumPy array"),
    (b"\x1f\x8b", "a gzip archive"),
    (b"7z\xbc\xaf", "a 7z archive"),
    (b"\x28\xb5\x2f\xfd", "a Zstandard archive, such as of a ROS 2 bag (unpack it by `zstd -d`)"),
    (b"PTG\0", "a PTG scan (export PTX or E57 instead)"),
)
_DESCRIPTOR_FIELD = re.compile(rb'"kind"\s*:\s*"(' + "|".join(DESCRIPTOR_KINDS).encode() + rb')"')


@dataclass(frozen=True, slots=True)
class FileFormat:
    """One supported file format."""

    name: str
    """Name for users."""
    kind: FileKind
    """Kind of content."""
    extensions: tuple[str, ...]
    """Usual file name extensions, lower case, with their dot."""
    sniff: Callable[[bytes, Path], bool]
    """Returns whether a file has this format, from its first bytes or, where they are not enough, from the file."""
    describe: Callable[[Path, ScanRequest], FileInfo]
    """Describes a file of this format; the request concerns scans only."""
    read_scan: Callable[[Path, ScanRequest], Scan] | None = None
    """Reads the scan. Scan formats only."""
    takes: tuple[str, ...] = ()
    """Names of the options of `ScanRequest` that this format has a use for; others are refused."""
    is_generic_text: bool = False
    """Whether files of other programs commonly have the same extensions, so that a listing must check the content."""
    examples: tuple[str, ...] = ()
    """Names of the file types that it comprises, for users; empty: its name is enough."""


def _json_kind(head: bytes, file: Path) -> FileKind | None:
    """Return the kind of a JSON file by its fields; None where it is not JSON."""
    if not looks_like_json(head):
        return None
    try:
        fields = read_json_object(file, "a JSON file")
    except FormatError:  # damaged or too large: decide by the names in its first bytes, so that its reader says why
        fields = {word: True for word in ("kind", "matches", POSE_FIELD, WORLD_FIELD, "fx", "camera_matrix", "fl_x",
                                             "transform_matrix")
                  if json.dumps(word).encode() in head}  # fmt: skip
    if POSE_FIELD in fields or WORLD_FIELD in fields:
        return "pose"
    if "matches" in fields:
        return "matches"
    if ("kind" in fields and "fx" not in fields) or "depth" in fields:
        return "scan"
    if is_nerfstudio(fields) or "transform_matrix" in fields:
        return "camera"
    if "fx" in fields or fields.get("model") == "equirectangular" or is_calibration(fields):
        return "camera"
    return "scan"  # the descriptor's reader says what is missing


def _sniff_json(kind: FileKind) -> Callable[[bytes, Path], bool]:
    return lambda head, file: _json_kind(head, file) == kind


def _sniff_csv(head: bytes, file: Path) -> bool:
    line = head.removeprefix(b"\xef\xbb\xbf").lstrip().partition(b"\n")[0].lower()
    return {b"u", b"v"} <= {cell.strip() for cell in line.split(b",")}


def _by_path(describe: Callable[[Path], FileInfo]) -> Callable[[Path, ScanRequest], FileInfo]:
    return lambda path, _: describe(path)


def _read_npz(path: Path, asked: ScanRequest) -> Scan:
    return read_npz(path, memory_bytes=asked.memory_bytes, report=asked.report)


def _read_pcd(path: Path, asked: ScanRequest) -> Scan:
    return read_pcd(
        path, origin=asked.origin, intensity=asked.intensity, memory_bytes=asked.memory_bytes, report=asked.report
    )


def _read_ptx(path: Path, asked: ScanRequest) -> Scan:
    return read_ptx(
        path, scan_index=asked.scan_index, origin=asked.origin, intensity=asked.intensity,
        memory_bytes=asked.memory_bytes, report=asked.report,
    )  # fmt: skip


def _read_ply(path: Path, asked: ScanRequest) -> Scan:
    return read_ply(
        path, origin=asked.origin, intensity=asked.intensity, memory_bytes=asked.memory_bytes, report=asked.report
    )


def _read_text(path: Path, asked: ScanRequest) -> Scan:
    return read_text_cloud(
        path, origin=asked.origin, intensity=asked.intensity, columns=asked.columns, memory_bytes=asked.memory_bytes,
        report=asked.report,
    )  # fmt: skip


def _read_float_bin(path: Path, asked: ScanRequest) -> Scan:
    return read_float_bin(path, origin=asked.origin, memory_bytes=asked.memory_bytes, report=asked.report)


def _read_las(path: Path, asked: ScanRequest) -> Scan:
    return read_las(
        path, origin=asked.origin, intensity=asked.intensity, memory_bytes=asked.memory_bytes, report=asked.report
    )


def _read_descriptor(path: Path, asked: ScanRequest) -> Scan:
    return read_descriptor(path, memory_bytes=asked.memory_bytes, report=asked.report)


def _camera_format(known: CameraFormat) -> FileFormat:
    def sniff(head: bytes, file: Path) -> bool:
        return (not known.is_json or _json_kind(head, file) == "camera") and known.sniff(head, file)

    return FileFormat(
        known.name, "camera", known.extensions, sniff, _by_path(describe_camera_file), is_generic_text=True
    )


def _read_packets(path: Path, asked: ScanRequest) -> Scan:
    with reading(path) as file:
        read = read_velodyne_pcap if is_velodyne(file) else read_ouster_pcap
    return read(path, scan_index=asked.scan_index, memory_bytes=asked.memory_bytes, report=asked.report)


def _read_bag(path: Path, asked: ScanRequest) -> Scan:
    return read_bag(
        path, topic=asked.topic, seconds=asked.seconds, origin=asked.origin, intensity=asked.intensity,
        memory_bytes=asked.memory_bytes, report=asked.report,
    )  # fmt: skip


FORMATS: tuple[FileFormat, ...] = (
    FileFormat(
        "E57", "scan", (".e57",), lambda head, _: sniff_e57(head), describe_e57,
        lambda path, asked: read_e57(
            path, scan_index=asked.scan_index, origin=asked.origin, intensity=asked.intensity,
            memory_bytes=asked.memory_bytes, report=asked.report,
        ),
        takes=("scan_index", "origin", "intensity"),
    ),
    FileFormat(
        "NPZ", "scan", (".npz",), lambda head, _: sniff_npz(head), scan_describer("NPZ", _read_npz), _read_npz,
    ),
    FileFormat(
        "PCD", "scan", (".pcd",), lambda head, _: sniff_pcd(head), scan_describer("PCD", _read_pcd), _read_pcd,
        takes=("origin", "intensity"),
    ),
    FileFormat(
        "PTX", "scan", (".ptx",), lambda head, _: sniff_ptx(head), describe_ptx, _read_ptx,
        takes=("scan_index", "origin", "intensity"),
    ),
    FileFormat(
        "lidar PCAP", "scan", (".pcap", ".pcapng"), lambda head, _: sniff_capture(head),
        scan_describer("lidar PCAP", _read_packets), _read_packets, takes=("scan_index",),
    ),
    FileFormat(
        "ROS bag", "scan", (".bag", ".db3", ".mcap"), lambda head, _: sniff_recording(head), describe_bag, _read_bag,
        takes=("topic", "seconds", "origin", "intensity"), examples=("ROS bag", "MCAP"),
    ),
    FileFormat(
        "PLY", "scan", (".ply",), lambda head, _: sniff_ply(head), scan_describer("PLY", _read_ply), _read_ply,
        takes=("origin", "intensity"),
    ),
    FileFormat(
        "PTS", "scan", (".pts",), lambda head, _: sniff_pts(head), scan_describer("PTS", _read_text), _read_text,
        takes=("origin", "intensity", "columns"),
    ),
    FileFormat(
        "LAS", "scan", (".las", ".laz"), lambda head, _: sniff_las(head), describe_las, _read_las,
        takes=("origin", "intensity"), examples=("LAS", "LAZ"),
    ),
    FileFormat(
        "descriptor JSON", "scan", (".json",), _sniff_json("scan"),
        scan_describer(f"descriptor ({' or '.join(DESCRIPTOR_KINDS)})", _read_descriptor), _read_descriptor,
        is_generic_text=True,
    ),
    FileFormat(
        "image", "photo", (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp", ".avif", ".heic", ".heif"),
        lambda head, _: image_format(head) is not None, _by_path(describe_photo),
        examples=("PNG", "JPEG", "TIFF", "WebP", "AVIF", "BMP"),
    ),
    *(_camera_format(known) for known in CAMERA_FORMATS),
    FileFormat(  # behind the cameras: some of them are .bin, too, and say so in their first bytes
        "KITTI bin", "scan", (".bin",), sniff_float_bin, scan_describer("BIN", _read_float_bin), _read_float_bin,
        takes=("origin",), is_generic_text=True,
    ),
    FileFormat("pose JSON", "pose", (".json",), _sniff_json("pose"), _by_path(describe_pose), is_generic_text=True),
    FileFormat(
        "matches JSON", "matches", (".json",), _sniff_json("matches"), _by_path(describe_matches), is_generic_text=True
    ),
    FileFormat("matches CSV", "matches", (".csv",), _sniff_csv, _by_path(describe_matches), is_generic_text=True),
    FileFormat(
        "text cloud", "scan", (".xyz", ".csv", ".txt", ".asc"), lambda head, _: sniff_text_cloud(head),
        scan_describer("text cloud", _read_text), _read_text,
        takes=("origin", "intensity", "columns"), is_generic_text=True, examples=("XYZ", "CSV", "TXT"),
    ),
)  # fmt: skip
"""All formats, in the order in which they are tried."""


def recognise(path: PathLike, *, kinds: tuple[FileKind, ...] = ()) -> FileFormat:
    """Return the format of a file, determined by its content.

    Args:
        path: the file.
        kinds: the kinds of content that are wanted; empty: any.

    Raises:
        FormatError: if there is no such file, or its format is unknown or not of a wanted kind.
    """
    with reading(path) as file, parsed_once():
        with open(file, "rb") as stream:
            head = stream.read(_HEAD_BYTES)
        found = next((f for f in FORMATS if (not kinds or f.kind in kinds) and f.sniff(head, file)), None)
        if found is None:
            other = next((f for f in FORMATS if f.sniff(head, file)), None)
            what = f"it is a {other.kind} ({other.name})" if other else _unsupported(head)
            wanted = sorted({f"{f.name}" for f in FORMATS if not kinds or f.kind in kinds})
            raise FormatError(f"{what}; a {' or '.join(kinds) or 'file'} is one of {', '.join(wanted)}")
        return found


def _unsupported(head: bytes) -> str:
    """Return a phrase that says what an unsupported file appears to be, without a word of its content."""
    known = next((name for magic, name in _UNSUPPORTED if head.startswith(magic)), None)
    if known:
        return f"it is {known}, which is not supported"
    what = "binary" if b"\0" in head else "text"
    return f"its format is unknown (it is {what})"


def listed_kind(path: Path) -> FileKind | None:
    """Return the kind of a file for a listing of its folder; None where it cannot be opened.

    Files with the extension of a binary format are not read. Text files are, since most JSON, YAML and CSV files belong
    to other programs; a JSON object counts as a scan only if it says so itself.
    """
    suffix = path.suffix.lower()
    candidates = [f for f in FORMATS if suffix in f.extensions]
    if not candidates:
        return None
    if not any(f.is_generic_text for f in candidates):
        return candidates[0].kind
    try:
        found = recognise(path)
        if found.name == "descriptor JSON":
            with path.open("rb") as file:
                return found.kind if _DESCRIPTOR_FIELD.search(file.read(_HEAD_BYTES)) else None
    except (LadarregError, OSError):
        return None
    return found.kind


def read_scan(
    path: PathLike,
    *,
    more: Sequence[PathLike] = (),
    scan_index: int = 0,
    origin: tuple[float, float, float] | None = None,
    intensity: IntensitySource = "auto",
    columns: Sequence[str] = (),
    topic: str | None = None,
    seconds: float | None = None,
    memory_bytes: int | None = None,
    report: Report | None = None,
) -> Scan:
    """Read a scan, its format recognised by content.

    The file is decoded in the calling process, with its permissions; for files of strangers see `isolated`.

    Args:
        path: a file of one of the scan formats.
        more: further files that were taken from the same standpoint, the scanner at rest: the clouds are merged before
            they are arranged in a grid. The frame is that of `path`, and the other options hold for all.
        scan_index: index of the scan in files that contain several.
        origin: where the scanner stood, (3,) in the coordinates of the file, m; for clouds that are not in the
            scanner's frame.
        intensity: `luma` takes the luminance of the points' colours as the intensity.
        columns: names of the columns of a text file without a header.
        topic: topic of the clouds in a recording.
        seconds: duration over which the clouds of a recording are accumulated.
        memory_bytes: memory that the read may use at its peak, bytes; None: 1 GB, or 96 times the file's size if that
            is more.
        report: receives the progress.

    Raises:
        FormatError: if it is not a scan, is damaged, lacks the intensity asked for, or would need more memory than
            it may use.
        ShapeError: if its arrays disagree, there are no returns, or a file of `more` was plainly taken from elsewhere.
        OptionError: if there is no scan of that index, or the format does not support an option.
    """
    with begin_scan(
        path, more=more, scan_index=scan_index, origin=origin, intensity=intensity, columns=columns, topic=topic,
        seconds=seconds, memory_bytes=memory_bytes,
    ) as read:  # fmt: skip
        return read.result(report)


def begin_scan(path: PathLike, *, more: Sequence[PathLike] = (), **options: Any) -> BegunRead[Scan]:
    """Begin to read a scan; arguments and errors as of `read_scan`, but for `report`, which `result` takes."""
    if isinstance(more, (str, bytes)) or not isinstance(more, Sequence):
        raise OptionError(f"'more' is {more!r:.80}; give a list of files")
    asked, further = ScanRequest(**options), tuple(Path(file) for file in more)

    def finish(scan: Scan) -> Scan:
        return with_source(scan, [path, *further], {**asked.given(), "more": further})

    return BegunRead(_read_files, (path, further, asked), {}, finish=finish)


def _read_files(path: PathLike, more: Sequence[Path], asked: ScanRequest, report: Report | None = None) -> Scan:
    asked = msgspec.structs.replace(asked, report=report)
    if not more:
        return _read_one(path, asked)
    files = [Path(path), *more]
    return read_accumulated(files, lambda file: _read_one(file, asked), memory_bytes=asked.memory_bytes)


def _read_one(path: PathLike, asked: ScanRequest) -> Scan:
    with parsed_once():
        found = recognise(path, kinds=("scan",))
        asked.require_only(found.takes, found.name)
        assert found.read_scan is not None, "every scan format has a reader"
        return found.read_scan(Path(path), asked)


def describe(
    path: PathLike,
    *,
    scan_index: int = 0,
    origin: tuple[float, float, float] | None = None,
    intensity: IntensitySource = "auto",
    columns: Sequence[str] = (),
    topic: str | None = None,
    seconds: float | None = None,
    trust_edited: bool = False,
) -> FileInfo:
    """Describe a file of any supported format: scan, photograph, camera, pose, matches or results.

    Args:
        path: the file.
        scan_index: as `read_scan`, and so are the other options.
        trust_edited: describe results that were changed after they were written, too.

    Raises:
        LadarregError: if it cannot be read.
    """
    asked = ScanRequest(
        scan_index=scan_index,
        origin=origin,
        intensity=intensity,
        columns=columns,  # type: ignore[arg-type]  # any sequence; it is made a tuple
        topic=topic,
        seconds=seconds,
    )
    with parsed_once():
        results = describe_results(Path(path), trust_edited=trust_edited)
        if results is not None:
            asked.require_only((), results.format)
            return results
        found = recognise(path)
        asked.require_only(found.takes, found.name)
        return found.describe(Path(path), asked)
