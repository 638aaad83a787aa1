"""The target `e57`: the scans as they were, with the photographs' colours, and the photographs with their poses.

Where the scan was read from an E57, every scan, image and field of that file is copied unchanged; only the colours of
the exported scan, its `colorLimits` and images are added. From other files, and where ranges of the scan were replaced,
a new E57 with the scan's returns is made.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ladarreg_core.errors import ExportError, FormatError, LadarregError
from ladarreg_core.export.e57.colors import (
    COLORS,
    PLAIN,
    PointPainter,
    add_color_fields,
    color_limits,
)
from ladarreg_core.export.e57.new_file import append_scan, start_tree, write_new_scan
from ladarreg_core.export.e57.nodes import (
    NOTE,
    declare_note,
    new_guid,
    note_of,
    plain,
    pose_node,
    set_numbers,
    software_name,
    time_node,
)
from ladarreg_core.export.e57.pictures import Picture, pictures
from ladarreg_core.export.e57.tree import E57Copy, Made, library, new_e57
from ladarreg_core.export.json import software_document
from ladarreg_core.export.layered_scan import LayeredScan
from ladarreg_core.export.registered_scan import RegisteredPhoto, RegisteredScan, RegisteredSurvey, photo_id
from ladarreg_core.export.targets.folder import FileJob
from ladarreg_core.export.targets.stations import StationScans, stations_e57_files, stations_e57_refusal
from ladarreg_core.export.targets.target import ExportOptions
from ladarreg_core.formats.e57.header import E57ScanInfo, contents_of, read_e57_info, sniff_e57
from ladarreg_core.formats.e57.records import fields_of
from ladarreg_core.formats.e57.tree import SIGNATURE, E57File, E57Node, open_e57
from ladarreg_core.formats.parsing.untrusted import one_line, reading
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.frames import Rigid

_SENSOR_WIDTH_M = 0.036  # of a pinhole image whose sensor is not known: only the ratio to the focal length matters
_PICTURE_WEIGHT = 500_000  # points that take about as long as a picture


def e57_refusal(handed: RegisteredScan | RegisteredSurvey | StationScans, options: ExportOptions) -> str | None:
    """Return why the scan's file cannot be copied, or stations cannot be written; None if they can."""
    del options
    if isinstance(handed, StationScans):
        return stations_e57_refusal()
    try:
        library()
        if isinstance(handed, RegisteredSurvey):
            return None
        source = _source(handed)
        if source is None:
            return None
        with reading(source) as file:
            info = read_e57_info(file)
    except LadarregError as error:
        return str(error)
    texts = [field.name for scan in info.scans for field in scan.fields if not field.stored]
    if texts:
        return (
            f"the field {one_line(texts[0], 40)} of its points is not a number, and only numbers can be copied; export "
            "the scan without it"
        )
    if not 0 <= _index(handed) < len(info.scans):
        return f"{source.name} has no scan {_index(handed)} any more; read the scan again"
    return None


def e57_files(
    handed: RegisteredScan | RegisteredSurvey | StationScans, options: ExportOptions, report: Report | None
) -> Sequence[FileJob]:
    """Return `NAME.e57`, named like the scan's file; of a survey or stations, one with all scans."""
    del options
    if isinstance(handed, RegisteredSurvey):
        parts = [LayeredScan(one) for one in handed.scans]
        return [("survey.e57", lambda path: _write_scans(path, parts, note_of(handed), report))]
    if isinstance(handed, StationScans):
        return stations_e57_files(handed, report)
    name = photo_id(handed.scan.name if handed.scan_file is None else handed.scan_file.name)
    return [(f"{name}.e57", lambda path: _write(path, handed, report))]


def layered_e57_files(parts: Sequence[LayeredScan], report: Report | None) -> Sequence[FileJob]:
    """Return `cloud.e57` with the scans of a model, their layers as fields, and each photograph once.

    Raises:
        DependencyError: if the bindings of libe57 are not installed.
    """
    library()
    return [("cloud.e57", lambda path: _write_scans(path, parts, note_of(parts[0].handed), report))]


class _Told:
    """Reports the progress of one file in points; a picture counts like half a million."""

    def __init__(self, total: int, name: str, report: Report | None) -> None:
        self._done, self._total, self._label, self._report = 0, total, f"writing {name}", report

    def __call__(self, more: int = 0) -> None:
        self._done = min(self._done + more, self._total)
        if self._report is not None:
            self._report(Progress(self._done, self._total, self._label))


def _source(handed: RegisteredScan) -> Path | None:
    """Return the E57 that the scan was read from; None if it was another file, or the scan has other ranges."""
    path = handed.scan_file
    if path is None or not handed.ranges_as_read:
        return None
    try:
        with open(path, "rb") as stream:
            return path if sniff_e57(stream.read(len(SIGNATURE))) else None
    except OSError:
        return None


def _index(handed: RegisteredScan) -> int:
    return int(handed.scan_options.get("scan_index") or 0)


def _write(path: Path, handed: RegisteredScan, report: Report | None) -> None:
    handed.compute_colors(report)
    source = _source(handed)
    pictures_take = _PICTURE_WEIGHT * len(handed.photos)
    if source is None:
        told = _Told(int(np.count_nonzero(handed.scan.valid)) + pictures_take, path.name, report)
        told()
        with new_e57(path) as file:
            guid = write_new_scan(file, handed, told)
            _add_images(file, handed, guid, told)
        return
    try:
        with open_e57(source) as old:
            info = contents_of(old)
            told = _Told(sum(scan.points for scan in info.scans) + pictures_take, path.name, report)
            told()
            with new_e57(path) as file:
                _copy(old, file, handed, told, info.scans[_index(handed)])
                _add_images(file, handed, info.scans[_index(handed)].guid, told)
    except FormatError as error:
        path.unlink(missing_ok=True)
        said = str(error).removeprefix("the E57 cannot be copied: ")
        raise ExportError(
            f"the E57 cannot be copied: {one_line(said, 160)}; export the scan again from the program that made it"
        ) from error


def _write_scans(path: Path, parts: Sequence[LayeredScan], note: str, report: Report | None) -> None:
    """Write scans with their poses and layers; what their files had beside their returns is left out."""
    photos = {one.id for part in parts for one in part.handed.photos}
    points = sum(int(np.count_nonzero(part.handed.scan.valid)) for part in parts)
    told = _Told(points + _PICTURE_WEIGHT * len(photos), path.name, report)
    with new_e57(path) as file:
        data3d = start_tree(file, note)
        for part in parts:
            one = part.handed
            one.compute_colors(report)
            guid = append_scan(
                file, data3d, one.scan, note_of(one), told, colors=one.colors, values=part.values
            )  # fmt: skip
            _add_images(file, one, guid, told, only=photos)
            photos -= {each.id for each in one.photos}  # one that several scans see is there once


def _copy(old: E57File, file: Any, handed: RegisteredScan, told: _Told, info: E57ScanInfo) -> None:
    """Copy a file with the colours of one of its scans."""
    e57, copy, index = library(), E57Copy(file, told, old), _index(handed)
    copy.extensions()
    new = file.root()
    declare_note(file)
    made: dict[str, Made] = {
        "guid": lambda _: e57.StringNode(file, new_guid()),
        "creationDateTime": lambda _: time_node(file),
        "e57LibraryVersion": lambda _: e57.StringNode(file, software_name()),
        "images2D": lambda node: copy.vector(node, {}),
        "data3D": lambda node: copy.vector(
            node, {index: lambda scan: _painted(scan, file, copy, PointPainter(handed, info, old, scan, told))}
        ),
    }
    for child in old.root.children:
        if child.name != NOTE:
            make: Made = made.get(child.name, copy.node)
            new.set(child.name, make(child))
    if not new.isDefined("images2D"):
        new.set("images2D", e57.VectorNode(file, True))
    new.set(NOTE, e57.StringNode(file, note_of(handed)))
    copy.finish()


def _painted(scan: E57Node, file: Any, copy: E57Copy, painter: PointPainter) -> Any:
    """Return the copy of a scan with the photographs' colours."""
    channels = painter.channels

    def points(node: E57Node) -> Any:
        if channels is not None:
            return copy.records(node, fill=painter)
        dropped = [field.name for field in fields_of(node) if field.name in COLORS]
        return copy.records(node, lambda made: add_color_fields(made, file), painter, dropped)

    if channels is not None and scan.child("colorLimits") is not None:
        return copy.structure(scan, {"points": points})
    made = copy.structure(scan, {"points": points, "colorLimits": None})
    made.set("colorLimits", color_limits(file, channels or (PLAIN,) * 3))
    return made


def _add_images(
    file: Any, handed: RegisteredScan, scan_guid: str, told: _Told, *, only: Collection[str] | None = None
) -> None:
    """Append the photographs to the images of the file, all or `only` those of some ids."""
    images = file.root()["images2D"]
    for one in handed.photos:
        if only is not None and one.id not in only:
            continue
        for picture in pictures(one, told):
            _add_image(file, images, handed, one, picture, scan_guid)
            told()
        told(_PICTURE_WEIGHT)


def _add_image(
    file: Any, images: Any, handed: RegisteredScan, one: RegisteredPhoto, picture: Picture, scan_guid: str
) -> None:
    e57 = library()
    node, shape = e57.StructureNode(file), e57.StructureNode(file)
    node.set("guid", e57.StringNode(file, new_guid()))
    node.set("name", e57.StringNode(file, plain(picture.name)))
    node.set("description", e57.StringNode(file, plain(_about(one), 1000)))
    if scan_guid:
        node.set("associatedData3DGuid", e57.StringNode(file, scan_guid))
    world_from_scanner = handed.scan.world_from_scanner or Rigid.identity()
    photo_from_image = Rigid(picture.photo_from_image, np.zeros(3))
    node.set("pose", pose_node(file, world_from_scanner @ one.camera_from_scanner.inverse @ photo_from_image))
    blob = e57.BlobNode(file, len(picture.data))
    shape.set("jpegImage" if picture.is_jpeg else "pngImage", blob)
    camera, (width, height) = picture.camera, picture.size
    numbers: dict[str, float] = {"imageHeight": height, "imageWidth": width}
    kind = "visualReference"
    pinhole = None if camera is None else camera.as_pinhole
    panorama = None if camera is None else camera.as_panorama
    if pinhole is not None:
        kind, pixel = "pinhole", _SENSOR_WIDTH_M / width
        focal = pinhole.fx * pixel
        numbers |= {"focalLength": focal, "pixelHeight": focal / pinhole.fy, "pixelWidth": pixel}
        # Counted from the outer corner of the first pixel.
        numbers |= {"principalPointX": float(pinhole.cx + 0.5), "principalPointY": float(pinhole.cy + 0.5)}
    elif panorama is not None:
        left, top, right, bottom = panorama.window or (-180.0, 90.0, 180.0, -90.0)
        kind = "spherical"
        numbers["pixelHeight"] = float(np.radians(top - bottom) / height)
        numbers["pixelWidth"] = float(np.radians(right - left) / width)
    set_numbers(file, shape, numbers)
    node.set(f"{kind}Representation", shape)
    images.append(node)
    blob.write(np.frombuffer(picture.data, np.uint8).copy(), 0, len(picture.data))


def _about(one: RegisteredPhoto) -> str:
    words = f"registered to the scan with {software_document()['name']}: {one.registration.standing}"
    return f"{one.mark.capitalize()}: the pose was given and not solved" if one.mark else words
