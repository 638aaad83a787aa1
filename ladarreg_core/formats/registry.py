"""The one table of formats: how each is recognised, read and described."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.errors import FormatError, ShapeError
from ladarreg_core.formats import FileFormat, FileInfo, FileKind
from ladarreg_core.formats.camera_file import describe_camera, read_camera, sniff_camera_yaml
from ladarreg_core.formats.descriptor import KINDS, read_descriptor
from ladarreg_core.formats.e57 import read_e57
from ladarreg_core.formats.e57_header import E57ImageInfo, E57ScanInfo, read_e57_info, sniff_e57
from ladarreg_core.formats.e57_images import camera_of_image
from ladarreg_core.formats.exif import exif_facts, focal_from_exif, orientation_of, upright
from ladarreg_core.formats.image_file import image_format, read_image
from ladarreg_core.formats.json_file import read_json_object
from ladarreg_core.formats.matches_file import csv_rows
from ladarreg_core.formats.npz import read_npz, sniff_npz
from ladarreg_core.formats.pcd import read_pcd, sniff_pcd
from ladarreg_core.formats.pose_file import POSE_FIELD, read_pose
from ladarreg_core.formats.untrusted import one_line, reading, shown_name
from ladarreg_core.frames import ThesisParameters
from ladarreg_core.scan import Scan

_FOREIGN = (
    (b"ply", "a PLY model"),
    (b"LASF", "a LAS or LAZ cloud"),
    (b"\x89HDF", "an HDF5 file"),
    (b"glTF", "a GLB model"),
    (b"%PDF", "a PDF"),
    (b"\x93NUMPY", "a single NumPy array"),
    (b"\x1f\x8b", "a gzip archive"),
    (b"7z\xbc\xaf", "a 7z archive"),
)


def foreign_format(head: bytes) -> str:
    """Return what a file that cannot be read seems to be, in words."""
    known = next((name for magic, name in _FOREIGN if head.startswith(magic)), None)
    if known:
        return f"it is {known}, which is not read"
    start = one_line(head[:12].decode("latin-1"), 24)
    return f"it is of no known format (it begins with {start!r})"


def _json_kind(head: bytes, file: Path) -> FileKind | None:
    """Return what a JSON file is by its fields; the first bytes answer for most."""
    start = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    if not start.startswith(b"{"):
        return None
    try:
        fields = read_json_object(file, "a JSON file")
    except FormatError:  # damaged, or too large: by the words that it begins with, so that its reader tells why
        fields = {word: True for word in ("kind", "matches", POSE_FIELD, "fx", "camera_matrix")
                  if json.dumps(word).encode() in head}  # fmt: skip
    if POSE_FIELD in fields:
        return "pose"
    if "matches" in fields:
        return "matches"
    if "kind" in fields and "fx" not in fields:
        return "scan"
    if "fx" in fields or any("cameramatrix" in key.lower().replace("_", "") for key in fields) or "K" in fields:
        return "camera"
    return "scan"  # the descriptor's reader says what is missing


def _is_json(kind: FileKind) -> Any:
    return lambda head, file: _json_kind(head, file) == kind


def _is_csv(head: bytes, file: Path) -> bool:
    line = head.removeprefix(b"\xef\xbb\xbf").lstrip().partition(b"\n")[0].lower()
    return [cell.strip() for cell in line.split(b",")][-2:] == [b"u", b"v"]


def _describe_scan(path: Path, scan: Scan, name: str, **more: Any) -> FileInfo:
    ranges = scan.ranges[scan.valid]
    strength = scan.intensity[scan.valid]
    rows, columns = scan.shape
    return FileInfo(
        file=shown_name(path),
        bytes=path.stat().st_size,
        kind="scan",
        format=name,
        size=f"{rows} rows x {columns} columns",
        returns=int(scan.valid.sum()),
        range_m=(float(ranges.min()), float(ranges.max())),
        median_range_m=float(np.median(ranges)),
        intensity=(float(strength.min()), float(strength.max())),
        step_deg=(float(np.degrees(scan.geometry.step_rad[0])), float(np.degrees(scan.geometry.step_rad[1]))),
        color=scan.color is not None,
        notes=scan.notes,
        **more,
    )


def _describe_npz(path: Path) -> FileInfo:
    return _describe_scan(path, read_npz(path), "NPZ")


def _describe_pcd(path: Path) -> FileInfo:
    return _describe_scan(path, read_pcd(path), "PCD")


def _describe_descriptor(path: Path) -> FileInfo:
    return _describe_scan(path, read_descriptor(path), f"descriptor ({' or '.join(KINDS)})")


def _describe_e57(path: Path) -> FileInfo:
    with reading(path) as file:
        info = read_e57_info(file)
    lists: dict[str, Any] = {
        "scans": tuple(_scan_line(scan) for scan in info.scans),
        "images": tuple(_image_line(image) for image in info.images),
    }
    # Files of pictures only, and scans that lack something, are still described.
    notes: tuple[str, ...] = ()
    if len(info.scans) == 1 and "intensity" in info.scans[0].field_names:
        try:
            return _describe_scan(path, read_e57(path), "E57", **lists)
        except ShapeError as error:
            notes = (str(error),)
    return FileInfo(file=shown_name(path), bytes=path.stat().st_size, kind="scan", format="E57", notes=notes, **lists)


def _scan_line(scan: E57ScanInfo) -> str:
    grid = f"grid {scan.grid[0]} x {scan.grid[1]}" if scan.grid else "no grid"
    has = [word for word, name in (("intensity", "intensity"), ("colour", "colorRed")) if name in scan.field_names]
    return f"{scan.name}: {scan.points:,} points, {grid}, {' and '.join(has) or 'neither intensity nor colour'}"


def _image_line(image: E57ImageInfo) -> str:
    camera = camera_of_image(image)
    focal = f", focal length {camera.focal_px:.1f} px" if camera else ""
    pose = "with a pose" if image.world_from_image else "without a pose"
    return f"{image.name}: {image.kind} {image.format.upper()} {image.width} x {image.height}{focal}, {pose}"


def _describe_photo(path: Path) -> FileInfo:
    with reading(path) as file:
        image = read_image(file)
        raw_height, raw_width = image.values.shape[:2]
        height, width = upright(image.values, orientation_of(image.exif)).shape[:2]
        focal = focal_from_exif(image.exif, raw_width, raw_height)
        notes = () if focal else ("no focal length in EXIF: give a camera file or a focal length with it",)
        camera: dict[str, Any] = {}
        if focal:
            camera = {**describe_camera(Camera.from_focal(width, height, focal.focal_px)), "source": focal.source}
        return FileInfo(
            file=shown_name(file),
            bytes=file.stat().st_size,
            kind="photo",
            format=image.format,
            size=f"{width} x {height} pixels",
            color=image.values.ndim == 3,
            camera=camera,
            exif=exif_facts(image.exif),
            notes=notes,
        )


def _describe_camera(path: Path) -> FileInfo:
    camera = read_camera(path)
    return FileInfo(
        file=shown_name(path),
        bytes=path.stat().st_size,
        kind="camera",
        format="JSON" if _begins_with_brace(path) else "YAML",
        camera=describe_camera(camera),
    )


def _begins_with_brace(file: Path) -> bool:
    with open(file, "rb") as stream:
        return stream.read(64).lstrip(b"\xef\xbb\xbf \r\n\t").startswith(b"{")


def _describe_pose(path: Path) -> FileInfo:
    pose = read_pose(path)
    six = ThesisParameters.from_pose(pose)
    angles = (np.degrees(angle) for angle in (six.alpha, six.beta, six.gamma))
    return FileInfo(
        file=shown_name(path),
        bytes=path.stat().st_size,
        kind="pose",
        format="JSON",
        pose={
            "camera": six.in_words(),
            "pan_tilt_roll_deg": ", ".join(f"{angle:.2f}" for angle in angles),
        },
    )


def _describe_matches(path: Path) -> FileInfo:
    with reading(path) as file:
        is_csv = not _begins_with_brace(file)
        if is_csv:
            header, *rows = csv_rows(file)
            count, coordinates = f"{len(rows)} points", ",".join(header)
        else:
            fields = read_json_object(file, "a matches file")
            entries = fields["matches"] if isinstance(fields["matches"], list) else []
            lines_ = sum(isinstance(entry, dict) and entry.get("kind") == "line" for entry in entries)
            count, coordinates = f"{len(entries) - lines_} points, {lines_} lines", fields.get("scan_coordinates", "?")
        return FileInfo(
            file=shown_name(file),
            bytes=file.stat().st_size,
            kind="matches",
            format="CSV" if is_csv else "JSON",
            matches=f"{count} in {one_line(coordinates, 40)} coordinates",
        )


FORMATS: tuple[FileFormat, ...] = (
    FileFormat(
        "E57", "scan", lambda head, _: sniff_e57(head), _describe_e57,
        lambda path, index, memory, report: read_e57(path, scan_index=index, memory_bytes=memory, report=report),
    ),
    FileFormat(
        "NPZ", "scan", lambda head, _: sniff_npz(head), _describe_npz,
        lambda path, _, memory, report: read_npz(path, memory_bytes=memory, report=report),
    ),
    FileFormat(
        "PCD", "scan", lambda head, _: sniff_pcd(head), _describe_pcd,
        lambda path, _, memory, report: read_pcd(path, memory_bytes=memory, report=report),
    ),
    FileFormat(
        "descriptor JSON", "scan", _is_json("scan"), _describe_descriptor,
        lambda path, _, memory, report: read_descriptor(path, memory_bytes=memory, report=report),
    ),
    FileFormat("picture", "photo", lambda head, _: image_format(head) is not None, _describe_photo),
    FileFormat("camera JSON", "camera", _is_json("camera"), _describe_camera),
    FileFormat("camera YAML", "camera", lambda head, _: sniff_camera_yaml(head), _describe_camera),
    FileFormat("pose JSON", "pose", _is_json("pose"), _describe_pose),
    FileFormat("matches JSON", "matches", _is_json("matches"), _describe_matches),
    FileFormat("matches CSV", "matches", _is_csv, _describe_matches),
)  # fmt: skip
