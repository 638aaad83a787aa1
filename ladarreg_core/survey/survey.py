"""`Survey`: scans, cameras and photographs of one place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from ladarreg_core.errors import OptionError
from ladarreg_core.export.registered_scan import photo_id
from ladarreg_core.foundations.progress import Report
from ladarreg_core.frames import Rigid
from ladarreg_core.photo import Photo
from ladarreg_core.scan import Scan
from ladarreg_core.survey.parts import (
    SurveyCamera,
    SurveyLine,
    SurveyParts,
    SurveyPhoto,
    SurveyScan,
    SurveyTie,
    faults_of,
    listed_faults,
)
from ladarreg_core.survey.survey_file import read_survey_parts, survey_parts_of_folder, write_survey


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Survey:
    """Scans, cameras and photographs of one place.

    Raises:
        OptionError: if it has faults; all are listed.
    """

    scans: tuple[SurveyScan, ...]
    """One or more."""
    cameras: tuple[SurveyCamera, ...]
    """Those of the photographs."""
    photos: tuple[SurveyPhoto, ...]
    """One or more."""
    rigs: Mapping[str, Mapping[str, Rigid | None]] = field(default_factory=dict)
    """For each rig, by the names of its sensors, `sensor_from_reference` if it is known; the first sensor is the
    reference."""
    ties: tuple[SurveyTie, ...] = ()
    """Points that were marked by hand in two photographs."""
    lines: tuple[SurveyLine, ...] = ()
    """Straight edges that were drawn by hand in several photographs."""

    def __post_init__(self) -> None:
        faults = faults_of(self)
        if faults:
            raise OptionError(listed_faults("the survey", faults))

    @staticmethod
    def from_file(path: str | Path) -> Survey:
        """Return the survey of a `survey.json`, or of a folder as `from_folder` does.

        Raises:
            FormatError: if the file has faults; all are listed, files that are missing among them.
        """
        return Survey.from_folder(path) if Path(path).is_dir() else _of_parts(read_survey_parts(path))

    @staticmethod
    def from_folder(folder: str | Path, *, report: Report | None = None) -> Survey:
        """Return the survey of the scans and photographs in a folder, recognised by content.

        Photographs of the same body, lens, focal length and size, by EXIF, share a camera.

        Raises:
            OptionError: if it has no scan or no photograph, or cannot be listed.
        """
        return _of_parts(survey_parts_of_folder(folder, report=report))

    @staticmethod
    def of(scans: Sequence[Scan], photos: Sequence[Photo], *, cameras: Sequence[int] | None = None) -> Survey:
        """Return the survey of scans and photographs in memory.

        Args:
            scans: one or more; where their `world_from_scanner` is not None, it is where they stood.
            photos: one or more.
            cameras: number of the camera that took each photograph, from 0; None: one each.
        """
        of_photo = list(range(len(photos))) if cameras is None else list(cameras)
        if len(of_photo) != len(photos):
            raise OptionError(f"there are {len(photos)} photographs and cameras for {len(of_photo)}; give one for each")
        scan_ids, photo_ids = _ids([one.name for one in scans]), _ids([one.name for one in photos])
        return Survey(
            scans=tuple(SurveyScan(id=name, source=scan) for name, scan in zip(scan_ids, scans, strict=True)),
            cameras=tuple(SurveyCamera(id=f"camera-{k + 1}") for k in sorted(set(of_photo))),
            photos=tuple(
                SurveyPhoto(id=name, source=photo, camera=f"camera-{k + 1}")
                for name, photo, k in zip(photo_ids, photos, of_photo, strict=True)
            ),
        )  # fmt: skip

    def to_file(self, path: str | Path) -> None:
        """Write a `survey.json`, whose paths are relative to its folder.

        Raises:
            ExportError: if it cannot be written, or a scan or photograph has no file.
        """
        write_survey(path, self)


def _of_parts(parts: SurveyParts) -> Survey:
    return Survey(
        scans=tuple(parts.scans), cameras=tuple(parts.cameras), photos=tuple(parts.photos), rigs=parts.rigs,
        ties=tuple(parts.ties), lines=tuple(parts.lines),
    )  # fmt: skip


def _ids(names: Sequence[str]) -> list[str]:
    found: list[str] = []
    for name in names:
        found.append(photo_id(name, found))
    return found
