"""Descriptions of files for the user: kind, format, size and what the header or the data show."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ladarreg_core.camera import Camera, EquirectangularCamera
from ladarreg_core.errors import CameraError, FormatError, OptionError, ShapeError, UnderspecifiedError
from ladarreg_core.formats.cameras.camera_file import camera_format, describe_camera, read_cameras
from ladarreg_core.formats.cameras.camera_in_file import FileCamera
from ladarreg_core.formats.documents.matches_file import csv_rows
from ladarreg_core.formats.documents.pose_file import POSE_FIELD, WORLD_FIELD, read_pose
from ladarreg_core.formats.e57.header import E57ImageInfo, E57Info, E57ScanInfo, read_e57_info
from ladarreg_core.formats.e57.pages import require_intact_pages
from ladarreg_core.formats.e57.reader import read_e57
from ladarreg_core.formats.e57_images import camera_of_image
from ladarreg_core.formats.parsing.json_file import begins_with_brace, parsed_once, read_json_object
from ladarreg_core.formats.parsing.untrusted import one_line, reading, shown_name
from ladarreg_core.formats.photos.exif import (
    edited_since,
    exif_facts,
    focal_from_exif,
    focal_mm_of,
    orientation_of,
    upright,
)
from ladarreg_core.formats.photos.gpano import WHICH_CAMERA, looks_like_panorama, panorama_of_xmp
from ladarreg_core.formats.photos.image_file import ImageData, read_image
from ladarreg_core.formats.photos.radiometric import radiometric_maker
from ladarreg_core.formats.scans.bag import bag_topics, picture_topics, read_bag
from ladarreg_core.formats.scans.las import las_facts, read_las
from ladarreg_core.formats.scans.las_header import read_las_header
from ladarreg_core.formats.scans.ptx import PtxBlock, ptx_blocks, read_ptx
from ladarreg_core.formats.scans.scan_request import ScanRequest
from ladarreg_core.foundations.temperatures import kelvin_of, needs_unit, shown_values
from ladarreg_core.frames import ThesisParameters, describe_direction, describe_position, describe_world
from ladarreg_core.scan import Scan

FileKind = Literal["scan", "photo", "camera", "pose", "matches", "results"]
_MAX_LISTED = 50
_MAX_DESCRIBED_BY_READING = 2_000_000


@dataclass(frozen=True, kw_only=True)
class FileInfo:
    """Description of one file; what does not apply is None or empty."""

    file: str
    """File name."""
    bytes: int
    """File size."""
    kind: FileKind
    """Kind of content."""
    format: str
    """Name of the file format."""
    verdict: str | None = None
    """Verdict of a registration."""
    evidence: str | None = None
    """What it rests on: `image`, `statistics`, `given` or `none`."""
    method: str | None = None
    """Method of a registration."""
    reasons: tuple[str, ...] = ()
    """Reasons of the verdict."""
    size: str | None = None
    """Rows and columns, or width and height."""
    returns: int | None = None
    """Number of cells with a range."""
    range_m: tuple[float, float] | None = None
    """Smallest and largest range, m."""
    median_range_m: float | None = None
    """Median range, m."""
    intensity: tuple[float, float] | None = None
    """Smallest and largest intensity, in the sensor's unit."""
    step_deg: tuple[float, float] | None = None
    """Angle between rows and between columns, degrees."""
    color: bool | None = None
    """Whether the scanner recorded colour."""
    scans: tuple[str, ...] = ()
    """Scans of a file that can contain several."""
    images: tuple[str, ...] = ()
    """Embedded images."""
    camera: Mapping[str, Any] = field(default_factory=dict)
    """Camera intrinsics."""
    cameras: tuple[str, ...] = ()
    """Cameras of a file with several."""
    exif: Mapping[str, Any] = field(default_factory=dict)
    """EXIF facts."""
    pose: Mapping[str, Any] = field(default_factory=dict)
    """Pose, formatted."""
    world: Mapping[str, Any] = field(default_factory=dict)
    """Where the scanner stands in the world, formatted; empty: the file does not state it."""
    matches: str | None = None
    """Number of points and lines."""
    rejected_guess: Mapping[str, Any] = field(default_factory=dict)
    """Best candidate of a refused registration, formatted; it is no pose."""
    sigma: Mapping[str, Any] = field(default_factory=dict)
    """Standard deviations of a pose."""
    contents: tuple[str, ...] = ()
    """What a file of results, or of the pictures of a camera, consists of."""
    inputs: tuple[str, ...] = ()
    """Files that results were made of."""
    made_by: str | None = None
    """Software that wrote results."""
    checksum: str | None = None
    """Whether a document of results is as it was written, in words."""
    notes: tuple[str, ...] = ()
    """Remarks that the operator should read."""


def scan_describer(
    format_name: str, read: Callable[[Path, ScanRequest], Scan]
) -> Callable[[Path, ScanRequest], FileInfo]:
    """Return the `describe` function of a format whose scans are described by reading them."""
    return lambda path, asked: _describe_scan(path, read(path, asked), format_name)


def _describe_scan(path: Path, scan: Scan, format_name: str, **more: Any) -> FileInfo:
    ranges = scan.ranges[scan.valid]
    intensity = scan.intensity[scan.valid]
    rows, columns = scan.shape
    return FileInfo(
        file=shown_name(path),
        bytes=path.stat().st_size,
        kind="scan",
        format=format_name,
        size=f"{rows} rows x {columns} columns",
        returns=int(scan.valid.sum()),
        range_m=(float(ranges.min()), float(ranges.max())),
        median_range_m=float(np.median(ranges)),
        intensity=(float(intensity.min()), float(intensity.max())),
        step_deg=(float(np.degrees(scan.geometry.step_rad[0])), float(np.degrees(scan.geometry.step_rad[1]))),
        color=scan.color is not None,
        world={} if scan.world_from_scanner is None else describe_world(scan.world_from_scanner),
        notes=scan.notes,
        **more,
    )


def describe_e57(path: Path, asked: ScanRequest) -> FileInfo:
    """Describe an E57 file: its scan in detail if there is only one or one is asked for, else all from its header."""
    with reading(path) as file:
        info = read_e57_info(file)
        several = len(info.scans) > 1
        scans = tuple(_scan_line(number if several else None, scan) for number, scan in enumerate(info.scans))
        lists: dict[str, Any] = {"scans": scans, "images": tuple(_image_line(image, info) for image in info.images)}
        if asked.scan_index and asked.scan_index >= len(info.scans):
            raise OptionError(f"there is no scan {asked.scan_index}; the file contains {len(info.scans)}")
        looked_at = require_intact_pages(file)
    # Files with images only, and scans that cannot be used, are still described.
    notes: tuple[str, ...] = (looked_at,) if looked_at else ()
    if len(info.scans) == 1 or asked.given():
        try:
            return _describe_scan(path, read_e57(path, **_e57_options(asked)), "E57", **lists)
        except (ShapeError, FormatError) as error:
            if "intensity" in info.scans[asked.scan_index].field_names and isinstance(error, FormatError):
                raise
            notes = (*notes, str(error))
    return FileInfo(file=shown_name(path), bytes=path.stat().st_size, kind="scan", format="E57", notes=notes, **lists)


def _e57_options(asked: ScanRequest) -> dict[str, Any]:
    return {"scan_index": asked.scan_index, "origin": asked.origin, "intensity": asked.intensity}


def describe_bag(path: Path, asked: ScanRequest) -> FileInfo:
    """Describe a recording: its topics with clouds, and the scan in detail if it is clear which one is meant."""
    topics = bag_topics(path)
    lines = tuple(
        f"{one_line(each.name, 80)}: {each.messages:,} cloud{'s' * (each.messages != 1)}"
        for each in topics[:_MAX_LISTED]
    )
    pictures = tuple(
        f"{one_line(each.name, 80)}: {each.messages:,} picture{'s' * (each.messages != 1)}, "
        + (f"camera on {one_line(each.camera, 80)}" if each.camera else "without camera_info")
        for each in picture_topics(path)[:_MAX_LISTED]
    )
    try:
        scan = read_bag(
            path, topic=asked.topic, seconds=asked.seconds, origin=asked.origin, intensity=asked.intensity,
            report=asked.report,
        )  # fmt: skip
    except (ShapeError, UnderspecifiedError) as error:
        return FileInfo(
            file=shown_name(path), bytes=path.stat().st_size, kind="scan", format="ROS bag", scans=lines,
            images=pictures, notes=(str(error),),
        )  # fmt: skip
    return _describe_scan(path, scan, "ROS bag", scans=lines, images=pictures)


def describe_las(path: Path, asked: ScanRequest) -> FileInfo:
    """Describe a LAS or LAZ file: as a scan if it is small and says enough, else from its header alone."""
    with reading(path) as file, open(file, "rb") as stream:
        header = read_las_header(stream, file.stat().st_size)
    facts = las_facts(header)
    about = (
        f"{header.points:,} points, {facts['bounds']}",
        *([f"written by {header.software}"] * bool(header.software)),
    )
    crs = (f"the file's coordinate reference system is {header.crs}",) if header.crs else ()
    notes: tuple[str, ...] = ("described from its header alone: its points are read when it is opened",)
    if header.points <= _MAX_DESCRIBED_BY_READING:
        try:
            scan = read_las(path, origin=asked.origin, intensity=asked.intensity, report=asked.report)
        except (ShapeError, UnderspecifiedError) as error:
            notes = (str(error),)
        else:
            return _describe_scan(path, scan, facts["format"], scans=about)
    return FileInfo(
        file=shown_name(path),
        bytes=path.stat().st_size,
        kind="scan",
        format=facts["format"],
        color=header.has_color,
        scans=about,
        notes=(*notes, *crs),
    )


def describe_ptx(path: Path, asked: ScanRequest) -> FileInfo:
    """Describe a PTX file: its scan in detail if there is only one or one is asked for, else all from their headers."""
    blocks = ptx_blocks(path)
    scans = tuple(_block_line(number, block) for number, block in enumerate(blocks)) if len(blocks) > 1 else ()
    if len(blocks) == 1 or asked.scan_index:
        read = read_ptx(path, scan_index=asked.scan_index, intensity=asked.intensity)
        return _describe_scan(path, read, "PTX", scans=scans)
    return FileInfo(file=shown_name(path), bytes=path.stat().st_size, kind="scan", format="PTX", scans=scans)


def scans_in(path: Path, format_name: str) -> tuple[str, ...]:
    """Describe the scans of a file that may contain several, from its headers; empty for other formats."""
    if format_name == "E57":
        with reading(path) as file:
            return tuple(_scan_line(None, scan) for scan in read_e57_info(file).scans)
    if format_name == "PTX":
        return tuple(_block_line(number, block, flag="") for number, block in enumerate(ptx_blocks(path)))
    return ()


def _block_line(number: int, block: PtxBlock, *, flag: str | None = None) -> str:
    has = [word for word, there in (("intensity", block.has_intensity), ("colour", block.has_color)) if there]
    x, y, z = block.position
    cells = block.rows * block.columns
    truncated = "" if block.lines == cells else f", truncated after {block.lines:,}"
    shown = f" (`scan_index={number}`)" if flag is None else flag
    return (
        f"scan {number}{shown}: {cells:,} points, grid {block.rows} x {block.columns}, "
        f"{' and '.join(has) or 'neither intensity nor colour'}, stands at {x:.3f}, {y:.3f}, {z:.3f} m{truncated}"
    )


def _scan_line(number: int | None, scan: E57ScanInfo) -> str:
    """Describe a scan of an E57 file from its header; `number`: that it is chosen by, None if there is no choice."""
    grid = f"grid {scan.grid[0]} x {scan.grid[1]}" if scan.grid else "no grid"
    has = [word for word, name in (("intensity", "intensity"), ("colour", "colorRed")) if name in scan.field_names]
    words = [f"{scan.points:,} points", grid, " and ".join(has) or "neither intensity nor colour"]
    if scan.world_from_scanner is not None:
        x, y, z = scan.world_from_scanner.translation
        words.append(f"stands at {x:.3f}, {y:.3f}, {z:.3f} m")
    return f"{scan.name}{'' if number is None else f' (`scan_index={number}`)'}: {', '.join(words)}"


def _image_line(image: E57ImageInfo, info: E57Info) -> str:
    camera = camera_of_image(image)
    focal = f", focal length {camera.focal_px:.1f} px" if camera and camera.model == "pinhole" else ""
    pose = "with a pose" if image.world_from_image else "without a pose"
    scan = next((scan.name for scan in info.scans if scan.guid and scan.guid == image.associated_guid), None)
    linked = "" if scan is None else f", of scan {scan}"
    return f"{image.name}: {image.kind} {image.format.upper()} {image.width} x {image.height}{focal}, {pose}{linked}"


def describe_photo(path: Path) -> FileInfo:
    """Describe an image file: its size, its EXIF facts and the camera that they give."""
    with reading(path) as file:
        image = read_image(file)
        raw_height, raw_width = image.values.shape[:2]
        pixels = upright(image.values, orientation_of(image.exif))
        height, width = pixels.shape[:2]
        focal = focal_from_exif(image.exif, raw_width, raw_height)
        notes = [*image.notes, *_thermal_notes(file, image)]
        panorama, contradiction = _panorama_of(image, width, height)
        if contradiction:
            notes.append(contradiction)
        elif panorama is None and not focal:
            stated = focal_mm_of(image.exif)
            notes.append(
                "no focal length in EXIF: give a camera file or a focal length with it"
                if stated is None
                else f"EXIF states {stated:g} mm but not the sensor's size: give `sensor_mm` or a camera file with it"
            )
        if panorama is None and (edited := edited_since(image.exif, raw_width, raw_height)):
            notes.append(edited)
        if panorama is None and not contradiction and looks_like_panorama(pixels):
            notes.append(WHICH_CAMERA)
        camera: dict[str, Any] = {}
        if panorama is not None:
            camera = {**describe_camera(panorama), "source": "XMP"}
        elif focal and not contradiction:
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
            notes=tuple(notes),
        )


def _panorama_of(image: ImageData, width: int, height: int) -> tuple[EquirectangularCamera | None, str]:
    """Return the panorama's camera by the image's XMP, or else what contradicts it; None and an empty string."""
    try:
        return panorama_of_xmp(image.xmp, width, height), ""
    except CameraError as error:
        return None, str(error)


def _thermal_notes(file: Path, image: ImageData) -> list[str]:
    """Return what is known of a picture's temperatures, in a sentence; none for a photograph."""
    if (maker := radiometric_maker(file)) is not None:
        return [
            f"a radiometric JPEG of {maker}: its visible picture is in false colours; export the temperatures as TIFF"
        ]
    if image.temperature_unit is not None and image.values.dtype.kind == "f":
        return [f"a thermal image in {image.temperature_unit}, as its tags say"]
    if (kelvin := kelvin_of(image.values)) is not None:
        return [f"a thermal image, {float(kelvin.min()):.1f} to {float(kelvin.max()):.1f} K"]
    if needs_unit(image.values):
        shown = shown_values(image.values)
        return [f"its pixels, {shown}, may be temperatures: give `temperature_unit` C, K or none with it"]
    return []


def describe_camera_file(path: Path) -> FileInfo:
    """Describe a camera file: its camera, or a list of its cameras."""
    cameras = read_cameras(path)
    only = cameras[0] if len(cameras) == 1 else None
    return FileInfo(
        file=shown_name(path),
        bytes=path.stat().st_size,
        kind="camera",
        format=camera_format(path),
        camera={} if only is None else describe_camera(only.camera),
        contents=_pictures(only),
        cameras=() if only is not None else tuple(map(_camera_line, cameras[:_MAX_LISTED])),
        notes=tuple(dict.fromkeys(note for each in cameras for note in each.notes))[:_MAX_LISTED],
    )


def _pictures(only: FileCamera | None) -> tuple[str, ...]:
    """Return which pictures a file names that were taken with its only camera."""
    if only is None or not only.pictures:
        return ()
    more = ", ..." if len(only.pictures) > 1 else ""
    count = f"{len(only.pictures)} picture{'s' * (len(only.pictures) > 1)}"
    return (f"camera of {count} ({one_line(only.pictures[0], 60)}{more})",)


def _camera_line(each: FileCamera) -> str:
    """Return a line on one of several cameras: its name, its figures, and where it stands in a rig."""
    facts = describe_camera(each.camera)
    said = ", ".join(f"{name.removesuffix('_px').replace('_', ' ')} {value}" for name, value in facts.items())
    if each.camera_from_first is not None:
        said += f", its centre at {describe_position(each.camera_from_first.centre)} of the first camera"
    if each.pictures:
        said += f", {len(each.pictures)} pictures ({one_line(each.pictures[0], 40)}, ...)"
    return f"{one_line(each.name or '(no name)', 60)}: {said}"


def describe_pose(path: Path) -> FileInfo:
    """Describe a pose file."""
    with reading(path) as file, parsed_once():
        fields = read_json_object(file, "a pose file")
        in_world = read_pose(path, field=WORLD_FIELD) if fields.get(WORLD_FIELD) is not None else None
        camera_in_world: dict[str, Any] = {}
        if in_world is not None:
            camera_in_world["in_the_world"] = describe_position(in_world.centre)
            camera_in_world["looks"] = describe_direction(in_world.rotation[2])
        if fields.get(POSE_FIELD) is None and in_world is not None:
            return FileInfo(
                file=shown_name(file), bytes=file.stat().st_size, kind="pose", format="JSON", pose=camera_in_world
            )
    pose = read_pose(path)
    six = ThesisParameters.from_pose(pose)
    angles = (np.degrees(angle) for angle in (six.alpha, six.beta, six.gamma))
    return FileInfo(
        file=shown_name(path),
        bytes=path.stat().st_size,
        kind="pose",
        format="JSON",
        pose={
            "camera": six.describe_position(),
            "pan_tilt_roll_deg": ", ".join(f"{angle:.2f}" for angle in angles),
            **camera_in_world,
        },
    )


def describe_matches(path: Path) -> FileInfo:
    """Describe a matches file without the scan that its cells belong to."""
    with reading(path) as file:
        is_csv = not begins_with_brace(file)
        if is_csv:
            header, *rows = csv_rows(file)
            count, coordinates = f"{len(rows)} points", ",".join(header)
        else:
            fields = read_json_object(file, "a matches file")
            entries = fields["matches"] if isinstance(fields["matches"], list) else []
            lines = sum(isinstance(entry, dict) and entry.get("kind") == "line" for entry in entries)
            count, coordinates = f"{len(entries) - lines} points, {lines} lines", fields.get("scan_coordinates", "?")
            if coordinates == "point":
                coordinates = f"{fields.get('frame', 'scanner')} point"
        return FileInfo(
            file=shown_name(file),
            bytes=file.stat().st_size,
            kind="matches",
            format="CSV" if is_csv else "JSON",
            matches=f"{count} in {one_line(coordinates, 40)} coordinates",
        )
