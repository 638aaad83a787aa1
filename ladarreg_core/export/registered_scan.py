"""A scan with the photographs that are registered to it: what photographs are exported from."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from ladarreg_core.camera import CameraModel
from ladarreg_core.errors import ExportError
from ladarreg_core.export.output_frame import OutputFrame
from ladarreg_core.foundations.arrays import ByteArray
from ladarreg_core.foundations.progress import Report
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Pick
from ladarreg_core.photo import Photo
from ladarreg_core.quality.assessment import Assessment, assess
from ladarreg_core.results.registration import Registration
from ladarreg_core.scan import Scan
from ladarreg_core.surface.texture.best_photo import CellColors, PointColorer, PosedPhoto, best_photo, photo_labels
from ladarreg_core.surface.texture.registered_texture import RegisteredTexture, texture_scan

_NOT_IN_NAMES = re.compile(r"[^A-Za-z0-9._-]+")


@dataclass(frozen=True, eq=False)
class RegisteredPhoto:
    """A photograph with a pose that was accepted, or given."""

    id: str
    """Unique among the photographs of an export; ASCII letters, digits, dots, hyphens, underscores."""
    photo: Photo
    """The photograph."""
    registration: Registration
    """Its pose; its camera may have been estimated and replaces the photograph's."""
    file: Path | None = None
    """The file it was read from."""
    camera_file: Path | None = None
    """The file that its camera was read from."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """How the photograph was read: the arguments of `read_photo`."""
    saved_document: Callable[[], Mapping[str, Any]] | None = None
    """Returns the `registration.json` that it was read from; None: one is made of the registration."""
    saved_assessment: Callable[[], Assessment] | None = None
    """Returns its assessment, if it was made before; None: it is made anew."""
    matches: Sequence[Pick] = ()
    """The drawn matches that belong to the pose."""

    @property
    def camera(self) -> CameraModel:
        """The intrinsics to be written."""
        return self.registration.camera

    @property
    def camera_from_scanner(self) -> Rigid:
        """The pose."""
        return self.registration.camera_from_scanner

    @property
    def mark(self) -> str:
        """What every file must say of a pose that was not verified; empty for an accepted one."""
        return self.registration.mark

    @property
    def caveat(self) -> str:
        """The mark, or that an accepted pose is coarse; empty for any other."""
        return self.registration.caveat

    def assessment(self, scan: Scan) -> Assessment:
        """Return what the result is worth."""
        return assess(scan, self.registration) if self.saved_assessment is None else self.saved_assessment()


@dataclass(frozen=True, eq=False)
class RegisteredScan:
    """A scan with at least one registered photograph, or one with matches.

    Raises:
        ExportError: if there is no photograph, two have the same id, a pose was refused, or
            one under `refused` was not.
    """

    scan: Scan
    """The scan, in the scanner's frame."""
    photos: Sequence[RegisteredPhoto]
    """The photographs; where several see a cell, the best one colours it, see `colours`."""
    scan_file: Path | None = None
    """The file it was read from."""
    scan_options: dict[str, Any] = field(default_factory=dict)
    """How that file was read: the arguments of `read_scan`; further files under `more`."""
    frame: OutputFrame = field(default_factory=OutputFrame)
    """The frame of written points, models and poses; formats with a frame of their own say so."""
    refused: Sequence[RegisteredPhoto] = ()
    """Photographs whose pose was refused: results and reports show them with the reasons, and nothing else may."""
    drawn: Mapping[str, Sequence[Pick]] = field(default_factory=dict)
    """The matches of photographs without a pose, by their ids: results contain them, and nothing else does."""
    id: str = "scan"
    """Unique among the scans of a survey, and a file name."""
    of_survey: bool = False
    """Whether it is one of a survey's scans, which need not have photographs of their own."""
    ranges_as_read: bool = True
    """Whether the scan has the ranges of its file; if not, formats that copy points of files write the scan's."""

    def __post_init__(self) -> None:
        photos, refused = tuple(self.photos), tuple(self.refused)
        object.__setattr__(self, "photos", photos)
        object.__setattr__(self, "refused", refused)
        if any(one.registration.is_shown for one in refused):
            raise ExportError("a photograph with a pose is listed as refused; list it among the others")
        if not photos and not refused and not self.drawn and not self.of_survey:
            raise ExportError("there is no registered photograph to export; register one, or give its pose")
        ids = [*(one.id for one in (*photos, *refused)), *self.drawn]
        if len(set(ids)) < len(ids):
            raise ExportError(f"two photographs have the same id ({', '.join(ids)}); give each its own")
        for one in photos:
            if not one.registration.is_shown:
                raise ExportError(
                    f"the pose of {one.photo.name} was refused, so nothing can be exported with it; accept another "
                    "pose, or apply one that you know"
                )

    @cached_property
    def textures(self) -> tuple[RegisteredTexture, ...]:
        """Every photograph on the scan's grid."""
        return tuple(
            texture_scan(
                self.scan,
                one.photo,
                one.camera_from_scanner,
                camera=one.camera,
                covariance=one.registration.joint_covariance,
            )
            for one in self.photos
        )

    @cached_property
    def views(self) -> tuple[PosedPhoto, ...]:
        """The photographs with the poses and cameras by which they are drawn."""
        return tuple(
            PosedPhoto(one.photo, one.camera_from_scanner, one.camera, one.registration.joint_covariance)
            for one in self.photos
        )

    @cached_property
    def colors(self) -> CellColors:
        """The colours of the cells, each by the photograph that shows it best."""
        return best_photo(self.scan, self.views)

    def compute_colors(self, report: Report | None = None) -> None:
        """Compute `colors` with a report of the progress, unless they are there already."""
        if "colors" not in self.__dict__:
            self.__dict__["colors"] = best_photo(self.scan, self.views, report=report)

    def use_colors(self, colors: CellColors, photo_labels: Sequence[ByteArray]) -> None:
        """Take colours and `photo_labels` that were found otherwise than by the best photograph, as by a fusion."""
        self.__dict__["colors"], self.__dict__["photo_labels"] = colors, tuple(photo_labels)

    @cached_property
    def photo_labels(self) -> tuple[ByteArray, ...]:
        """(H, W) uint8 of every photograph: codes of `Label`, whether it colours the cell or not."""
        if len(self.views) == 1:
            return (self.colors.labels,)
        return tuple(photo_labels(self.scan, view) for view in self.views)

    def point_colorer(self) -> PointColorer:
        """Return what colours points that need not be cells of the scan."""
        return PointColorer(self.scan, self.views, self.colors)

    @property
    def marks(self) -> tuple[str, ...]:
        """A sentence for every photograph whose pose was not verified, or is coarse."""
        return tuple(f"{one.photo.name}: {one.caveat}" for one in self.photos if one.caveat)

    @property
    def scans(self) -> tuple[RegisteredScan, ...]:
        """Itself, as the scans of a survey."""
        return (self,)

    def scan_of(self, one: RegisteredPhoto) -> RegisteredScan:
        """Return itself, as the scan of one of its photographs."""
        del one
        return self

    def written_from_camera(self, one: RegisteredPhoto) -> Rigid:
        """Return the pose of a camera in the frame of the written points, its offset subtracted."""
        turned = one.camera_from_scanner.rotation @ self.frame.world_from_scanner.rotation.T
        return Rigid.from_centre(turned, self.frame.place(one.camera_from_scanner.centre[None])[0]).inverse


@dataclass(frozen=True, eq=False)
class RegisteredSurvey:
    """Scans of several places with their photographs, in the world that they share.

    Raises:
        ExportError: if there is no photograph, a scan is not written in the world or with another offset, or two scans
            or two photographs have the same id.
    """

    scans: Sequence[RegisteredScan]
    """The scans, each with the photographs that are registered to it, if any."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "scans", tuple(self.scans))
        if not self.photos and not self.refused:
            raise ExportError("there is no registered photograph to export; register one, or give its pose")
        frames = [one.frame for one in self.scans]
        if any(one.name != "world" or one.offset_m != frames[0].offset_m for one in frames):
            raise ExportError("scans of several places fit together in the world only; export in the frame 'world'")
        for ids in ([one.id for one in self.scans], [one.id for one in (*self.photos, *self.refused)]):
            if len(set(ids)) < len(ids):
                raise ExportError(f"two scans or two photographs have the same id ({', '.join(ids)}); rename one")

    @property
    def photos(self) -> tuple[RegisteredPhoto, ...]:
        """The photographs of all scans."""
        return tuple(one for scan in self.scans for one in scan.photos)

    @property
    def refused(self) -> tuple[RegisteredPhoto, ...]:
        """Those of all scans whose pose was refused."""
        return tuple(one for scan in self.scans for one in scan.refused)

    @property
    def frame(self) -> OutputFrame:
        """The frame of written points and poses: the world, less one offset for all."""
        return self.scans[0].frame

    @property
    def marks(self) -> tuple[str, ...]:
        """As `RegisteredScan.marks`, of all scans."""
        return tuple(mark for scan in self.scans for mark in scan.marks)

    def scan_of(self, one: RegisteredPhoto) -> RegisteredScan:
        """Return the scan that one of the photographs is registered to."""
        return next(scan for scan in self.scans if any(other is one for other in scan.photos))

    def written_from_camera(self, one: RegisteredPhoto) -> Rigid:
        """As `RegisteredScan.written_from_camera`."""
        return self.scan_of(one).written_from_camera(one)


Registered = RegisteredScan | RegisteredSurvey
"""What photographs are exported from."""


def photo_id(name: str, taken: Sequence[str] = ()) -> str:
    """Return an id made of a file name, different from those that are taken."""
    stem = _NOT_IN_NAMES.sub("-", Path(name).stem).strip("-.")[:60] or "photo"
    number, found = 2, stem
    while found.lower() in {one.lower() for one in taken}:
        found, number = f"{stem}-{number}", number + 1
    return found
