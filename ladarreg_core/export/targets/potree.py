"""The target `potree`: the coloured cloud as an octree, with the photographs standing in it, for Potree 1.8.

Coordinates are whole, also in the world, since the files state them in double precision. Potree's cameras have no lens
and look through the middle of their pictures, so that other photographs are resampled; those of one camera share its
file. Fisheye photographs and parts of panoramas become 360-degree images.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ladarreg_core.export.clouds.cloud_part import CloudPart
from ladarreg_core.export.json import write_document
from ladarreg_core.export.layered_scan import LayeredScan
from ladarreg_core.export.photo_files import WrittenPhoto, on_one_line, text_writer
from ladarreg_core.export.potree.octree import NumberedPart, PotreeOctree
from ladarreg_core.export.potree.page import PAGE
from ladarreg_core.export.potree.photographs import (
    ORIENTED_HEADER,
    PANORAMA_HEADER,
    camera_xml,
    oriented_camera,
    oriented_line,
    panorama_camera,
    panorama_line,
)
from ladarreg_core.export.registered_scan import Registered
from ladarreg_core.export.targets.folder import FileJob
from ladarreg_core.export.targets.target import ExportOptions
from ladarreg_core.foundations.progress import Report

_PANORAMAS = "panoramas"
_Line = Callable[[str, Any, Any], str]


def potree_files(handed: Registered, options: ExportOptions, report: Report | None) -> Sequence[FileJob]:
    """Return the octree, the photographs with their lists, `photographs.json` and `index.html`."""
    del options
    numbered, first = [], 1

    def parts() -> list[CloudPart]:
        for scan in handed.scans:
            scan.compute_colors(report)
        return [CloudPart(scan.scan, scan.colors, scan.frame) for scan in handed.scans]

    for scan in handed.scans:
        numbered.append(first)
        first += len(scan.photos)
    return _files(handed, parts, numbered, report)


def layered_potree_files(parts: Sequence[LayeredScan], report: Report | None) -> Sequence[FileJob]:
    """Return the same of a model below `potree/`: scans with their layers as attributes of the points."""
    clouds = [CloudPart(one.handed.scan, one.handed.colors, one.handed.frame, one.values) for one in parts]
    jobs = _files(parts[0].handed, lambda: clouds, [1] * len(parts), report)
    return [(f"potree/{name}", write) for name, write in jobs]


def _files(
    handed: Registered, parts: Callable[[], list[CloudPart]], first_photos: Sequence[int], report: Report | None
) -> list[FileJob]:
    photographs = _Photographs(handed, report)
    made: list[PotreeOctree] = []

    def write_points(path: Path) -> None:
        numbered = [NumberedPart(part, first) for part, first in zip(parts(), first_photos, strict=True)]
        made[:] = [
            PotreeOctree(numbered, offset_m=handed.frame.offset_m, description=photographs.description, report=report)
        ]
        made[0].write_points(path)

    return [
        ("pointcloud/octree.bin", write_points),  # first: the others state what stands in it
        ("pointcloud/hierarchy.bin", lambda path: made[0].write_hierarchy(path)),
        ("pointcloud/metadata.json", lambda path: made[0].write_metadata(path)),
        *photographs.files(),
        ("index.html", text_writer(PAGE)),
    ]


class _Photographs:
    """The photographs of an export: those of each camera in a folder, and the panoramas in one."""

    def __init__(self, handed: Registered, report: Report | None) -> None:
        self._handed = handed
        self._cameras: dict[tuple[int, int, float], list[WrittenPhoto]] = {}
        self._panoramas: list[WrittenPhoto] = []
        self._folders: dict[str, str] = {}
        for one in handed.photos:
            pinhole = one.camera.as_pinhole
            if pinhole is None:
                written = WrittenPhoto(one, panorama_camera(one.camera), extension=".jpg", report=report)
                self._panoramas.append(written)
                self._folders[one.id] = _PANORAMAS
                continue
            camera = oriented_camera(pinhole)
            group = self._cameras.setdefault((*camera.size, camera.focal_px), [])
            group.append(WrittenPhoto(one, camera, extension=".jpg", report=report))
            number = list(self._cameras).index((*camera.size, camera.focal_px)) + 1
            self._folders[one.id] = f"photographs/{number}"

    @property
    def description(self) -> str:
        """What the coordinates are, and which poses were not verified."""
        return "; ".join([self._frame_is, *self._handed.marks])

    @property
    def _frame_is(self) -> str:
        frame = self._handed.frame
        if frame.name == "world":
            return "world frame, as the scan's file states it; metres; nothing is subtracted"
        return frame.sentence

    def files(self) -> list[FileJob]:
        """Return pictures and lists."""
        jobs: list[FileJob] = []
        for group in self._cameras.values():
            folder, camera = self._folders[group[0].one.id], group[0].camera
            jobs.append((f"{folder}/camera.xml", text_writer(camera_xml(camera))))
            lines = [ORIENTED_HEADER, *(self._line(each, oriented_line) for each in group)]
            jobs.append((f"{folder}/photographs.txt", text_writer("\n".join(lines) + "\n")))
            jobs += [(f"{folder}/{each.name}", each.write) for each in group]
        if self._panoramas:
            lines = [PANORAMA_HEADER, *(self._line(each, panorama_line) for each in self._panoramas)]
            jobs.append((f"{_PANORAMAS}/coordinates.txt", text_writer("\n".join(lines) + "\n")))
            jobs += [(f"{_PANORAMAS}/{each.name}", each.write) for each in self._panoramas]
        return [*jobs, ("photographs.json", lambda path: write_document(path, self._document()))]

    def _line(self, written: WrittenPhoto, line: _Line) -> str:
        world_from_camera = self._handed.written_from_camera(written.one)
        place = world_from_camera.translation + np.array(self._handed.frame.offset_m)
        return line(written.name, place, world_from_camera.rotation)

    def _document(self) -> dict[str, Any]:
        written = {each.one.id: each for group in (*self._cameras.values(), self._panoramas) for each in group}
        return {
            "frame_is": self._frame_is,
            "poses": list(self._handed.marks),
            "cameras": [self._folders[group[0].one.id] for group in self._cameras.values()],
            "panoramas": _PANORAMAS if self._panoramas else None,
            "photographs": [
                {
                    "photo_id": number,
                    "id": one.id,
                    "name": on_one_line(one.photo.name),
                    "file": f"{self._folders[one.id]}/{written[one.id].name}",
                    "pose_is": one.registration.standing,
                    "is_resampled": written[one.id].is_undistorted,
                }
                for number, one in enumerate(self._handed.photos, 1)
            ],
            "photo_id_is": "that of the points which the photograph colours; 0: none does",
        }
