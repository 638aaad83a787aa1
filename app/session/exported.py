"""What of a project is exported: its scan with photographs, their poses and matches, and its stations."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ladarreg_core.errors import OptionError
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.project.station_edits import is_stale, known_place, partner_of, surveyed_pose

from .loader import Loader
from .measured import Picked, in_common_frame, measured_places, photos_of, stale_poses

if TYPE_CHECKING:
    from ladarreg_core.export.output_frame import FrameName
    from ladarreg_core.export.registered_scan import RegisteredPhoto, RegisteredScan
    from ladarreg_core.export.targets.measurements import MeasurementList
    from ladarreg_core.export.targets.pipeline import Source as ExportSource
    from ladarreg_core.export.targets.stations import StationScans
    from ladarreg_core.export.targets.target import Target
    from ladarreg_core.matches import Pick
    from ladarreg_core.photo import Photo
    from ladarreg_core.project.document import Document, PhotoEntry, Survey
    from ladarreg_core.project.source import Source
    from ladarreg_core.project.storage.folder import ProjectFolder
    from ladarreg_core.quality.assessment import Assessment
    from ladarreg_core.quality.smoothing import SmoothedScan
    from ladarreg_core.results.registration import Registration
    from ladarreg_core.scan import Scan


@dataclass(frozen=True, slots=True, eq=False)
class ExportedPose:
    """The shown pose of a photograph."""

    registration: Registration
    """The pose."""
    assessment: Assessment
    """Its assessment."""
    inputs: Sequence[tuple[Path, str]]
    """The files of the scan, the photograph and its camera, in this order, then further clouds of the scan; with their
    names for display: uploaded files have random ones."""
    read_with: Sequence[Mapping[str, Any]]
    """The options that the scan and the photograph are read with."""
    picks: Sequence[Pick]
    """The matches that belong to it: the present ones, or those that it was solved on if it is out of date."""
    rests_on: Mapping[str, Any] | None
    """The matches that it was solved on, and whether these and the scan are still the same; None: not known."""
    smoothed: SmoothedScan | None = None
    """The scan, if some of its ranges were replaced."""

    def document(self, folder: Path | None = None) -> dict[str, Any]:
        """Return its `registration.json`, with the inputs' paths from a folder where that is known.

        Raises:
            ExportError: if an input cannot be read again.
        """
        from ladarreg_core.export.json import registration_document

        document = registration_document(
            self.registration, assessment=self.assessment, smoothed=self.smoothed, inputs=self.inputs,
            read_with=self.read_with, folder=folder,
        )  # fmt: skip
        return document if self.rests_on is None else {**document, "rests_on": self.rests_on}

    def write_report(self, path: Path, scan: Scan, photo: Photo) -> None:
        """Write its report, which replaces a file of this name in one step.

        Raises:
            LadarregError: if an input cannot be read again, or the file cannot be written.
        """
        from ladarreg_core.export.report.page import write_report
        from ladarreg_core.storage.atomic_write import replaced_file

        document = self.document()
        with replaced_file(path) as new:
            write_report(new, self.registration, scan, photo, document)


def exported_pose(
    loader: Loader, folder: ProjectFolder, document: Document, entry: PhotoEntry, scan: Scan
) -> ExportedPose:
    """Return the shown pose of a photograph.

    Raises:
        OptionError: if there is none.
        LadarregError: if its matches are missing or damaged.
    """
    from ladarreg_core.project.smoothing_edits import smoothed_scan
    from ladarreg_core.project.staleness import rests_on

    pose = entry.pose
    if pose is None:
        raise OptionError("there is no pose to export; solve first")
    sources = [document.scan, entry.source, entry.camera.file]
    inputs = [(folder.source_path(source.path), source.name) for source in sources if source is not None]
    reading: Mapping[str, Any] = {}
    if document.scan is not None:
        names = document.scan.names[1:]
        inputs += zip(folder.source_files(document.scan)[1:], names, strict=True)
        reading = {**document.scan.scan_options, "more": names}
    return ExportedPose(
        replace(loader.registration(pose), world_from_scanner=scan.world_from_scanner),
        loader.assessment(scan, pose),
        inputs,
        [reading, entry.photo_options],
        _matches(loader, document, entry),
        rests_on(entry, pose, loader.solved_on(pose), document.clouds, document.ranges),
        smoothed_scan(scan, document, entry.station),
    )


def _matches(loader: Loader, document: Document, entry: PhotoEntry) -> list[Pick]:
    """Return the matches that belong to the shown pose: those it was solved on if it is out of date."""
    then = None if entry.pose is None else loader.solved_on(entry.pose)
    stale = entry.pose is not None and loader.stale(document, entry, entry.pose)
    return [pick.as_pick() for pick in (then if stale and then is not None else entry.picks)]


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A photograph that is not exported."""

    id: str
    """Its id in the project."""
    name: str
    """Its file name."""
    why: str
    """The reason, without a full stop."""
    is_stale: bool = False
    """Whether its pose is only out of date."""


@dataclass(frozen=True, slots=True)
class Chosen:
    """Photographs of a project that can be exported to certain targets, and those that cannot."""

    entries: Sequence[PhotoEntry]
    """Those whose pose was accepted or given, or, if the targets show them, refused or missing beside matches."""
    left_out: Sequence[LeftOut]
    """The others."""

    @property
    def reasons(self) -> str:
        """Why the others are left out, in one clause; empty if there are none."""
        return "; ".join(f"{one.name}: {one.why}" for one in self.left_out)


def chosen_photos(
    loader: Loader,
    document: Document,
    photos: Collection[str] | None,
    *,
    targets: Collection[Target] = (),
    last_solved: bool = False,
) -> Chosen:
    """Return which photographs of a project are exported together.

    Args:
        loader: the project's loader.
        document: its document.
        photos: ids of photographs; None: all.
        targets: what they are written to; poses that were refused, and matches without a pose, are exported if all
            show them.
        last_solved: include poses that are out of date, as they were solved.

    Raises:
        LadarregError: if matches are missing or damaged.
    """
    single = len({entry.station for entry in document.photos if photos is None or entry.id in photos}) < 2
    with_refused = bool(targets) and all(target.shows_refused for target in targets)
    with_drawn = bool(targets) and all(target.shows_drawn for target in targets)
    entries, left_out = [], []
    for entry in document.photos:
        if photos is not None and entry.id not in photos:
            continue
        pose, name, stale = entry.pose, entry.source.name, ""
        if pose is None:
            why = "" if with_drawn and entry.picks else "it has no pose; register it"
        elif not single and known_place(document, entry.station) is None:
            why = "its station is not registered to the project's scan; register the stations, or export it by itself"
        elif not loader.registration(pose).is_shown and not with_refused:
            why = "its pose was not accepted; register it again"
        else:
            stale = "" if last_solved else loader.stale(document, entry, pose)
            why = f"its pose is out of date: {stale}, or export the last solved state" if stale else ""
        if why:
            left_out.append(LeftOut(entry.id, name, why, is_stale=bool(stale)))
        else:
            entries.append(entry)
    return Chosen(entries, left_out)


def project_sources(
    loader: Loader,
    folder: ProjectFolder,
    document: Document,
    entries: Sequence[PhotoEntry],
    targets: Sequence[Target],
    *,
    frame: FrameName = "scanner",
    written_into: Path | None = None,
    report: Report | None = None,
) -> list[ExportSource]:
    """Return what targets of a project are written from.

    Args:
        loader: the project's loader.
        folder: its folder.
        document: its document.
        entries: the photographs, see `chosen_photos`.
        targets: the targets.
        frame: of written points and poses.
        written_into: the folder of the results of one photograph, from which the inputs' paths are recorded.
        report: receives the progress, with the files' names.

    Raises:
        OptionError: if there is no scan, or the frame is `world` and the scan does not state where it stands.
        LadarregError: if a file can no longer be read.
    """
    from ladarreg_core.export.registered_scan import RegisteredScan
    from ladarreg_core.export.targets.measurements import MeasurementList
    from ladarreg_core.export.targets.stations import StationScans

    found: list[ExportSource] = []
    if entries and any(issubclass(RegisteredScan, target.reads) for target in targets):
        found.append(_registered_scan(loader, folder, document, entries, frame, written_into, report))
    if any(issubclass(StationScans, target.reads) for target in targets) and not stations_fault(document):
        found.append(_station_scans(loader, folder, document))
    if any(issubclass(MeasurementList, target.reads) for target in targets) and document.measurements:
        found.append(_measurements(loader, folder, document, frame))
    return found


def _measurements(loader: Loader, folder: ProjectFolder, document: Document, frame: FrameName) -> MeasurementList:
    from ladarreg_core.export.output_frame import OutputFrame
    from ladarreg_core.export.targets.measurements import MeasurementList
    from ladarreg_core.inspection.measuring.measurement_list import in_frame, write_measurements

    scan = loader.scan(document)
    if document.scan is None or scan is None:
        raise OptionError("the project has no scan; open one in the workbench")
    world = None if frame == "scanner" else OutputFrame.of(scan, frame).world_from_scanner
    entries = document.measurements
    listed = []
    for entry, measured in zip(entries, measured_places(loader, document, list(map(Picked.of, entries))), strict=True):
        one = in_common_frame(document, entry.station, measured)
        stale = stale_poses(loader, loader.seen_from_scan(document, entry.station), entry.places)
        listed.append(in_frame(one, None if one.own_frame else world, name=entry.title, more_flags=stale))
    photos = [document.photo(photo) for entry in entries for photo in photos_of(entry.places)]
    scans = [partner_of(document, entry.station) for entry in entries]
    sources = [document.scan, *filter(None, scans), *(photo.source for photo in photos if photo is not None)]
    inputs = [path for source in dict.fromkeys(sources) for path in folder.source_files(source)]
    return MeasurementList(lambda path: write_measurements(path, listed, frame=frame), inputs)


def stations_fault(document: Document) -> str:
    """Return why the stations of a project cannot be exported; empty if they can."""
    if not document.stations:
        return "there is one scan only; add scans of other stations"
    if document.survey is None or is_stale(document):
        return "the stations have not been registered as they are now; register them first"
    return ""


def beside_one_scan(
    loader: Loader, document: Document, entries: Sequence[PhotoEntry]
) -> tuple[Document, Sequence[PhotoEntry]]:
    """Return a document and photographs beside one scan: their own, or if they have several, that of the project, to
    which poses are carried over without matches.
    """
    if len({entry.station for entry in entries}) == 1:
        return document.beside(entries[0]), entries
    seen = loader.seen_from_scan(document)
    return seen, [found for entry in entries if (found := seen.photo(entry.id)) is not None]


def _registered_scan(
    loader: Loader,
    folder: ProjectFolder,
    document: Document,
    entries: Sequence[PhotoEntry],
    frame: FrameName,
    written_into: Path | None,
    report: Report | None,
) -> RegisteredScan:
    from ladarreg_core.export.output_frame import OutputFrame
    from ladarreg_core.export.registered_scan import RegisteredScan, photo_id

    document, entries = beside_one_scan(loader, document, entries)
    scan = loader.scan(document)
    if document.scan is None or scan is None:
        raise OptionError("the project has no scan; open one in the workbench")
    placed = OutputFrame.of(scan, frame)
    photos: list[RegisteredPhoto] = []
    drawn: dict[str, Sequence[Pick]] = {}
    for done, entry in enumerate(entries):
        if report is not None:
            report(Progress(done, len(entries), f"reading {entry.source.name}"))
        name = photo_id(entry.source.name, [*(one.id for one in photos), *drawn])
        if entry.pose is None:
            drawn[name] = _matches(loader, document, entry)
        else:
            photos.append(_photo(loader, folder, document, entry, scan, name, written_into))
    return RegisteredScan(
        scan,
        [one for one in photos if one.registration.is_shown],
        folder.source_path(document.scan.path),
        folder.scan_options(document.scan),
        placed,
        [one for one in photos if not one.registration.is_shown],
        drawn,
        ranges_as_read=not document.scan.smoothings,
    )


def _photo(
    loader: Loader,
    folder: ProjectFolder,
    document: Document,
    entry: PhotoEntry,
    scan: Scan,
    name: str,
    written_into: Path | None,
) -> RegisteredPhoto:
    from ladarreg_core.export.registered_scan import RegisteredPhoto

    pose, camera = entry.pose, entry.camera.file
    assert pose is not None, "it is among those with a pose"
    return RegisteredPhoto(
        name,
        loader.photo(entry),
        replace(loader.registration(pose), world_from_scanner=scan.world_from_scanner),
        folder.source_path(entry.source.path),
        None if camera is None else folder.source_path(camera.path),
        entry.photo_options,
        lambda: exported_pose(loader, folder, document, entry, scan).document(written_into),
        lambda: loader.assessment(scan, pose),
        _matches(loader, document, entry),
    )


def _station_scans(loader: Loader, folder: ProjectFolder, document: Document) -> StationScans:
    from ladarreg_core.export.outputs.station_folder import stations_document
    from ladarreg_core.export.targets.stations import StationScans

    survey = document.survey
    assert survey is not None, "the stations were registered"
    inputs = [(folder.source_path(source.path), source.index) for source in survey.scans]
    fields = stations_document(survey.fields, inputs)
    scans = {
        one["scan"]: partial(_placed, loader, survey, source, one["name"])
        for one, source in zip(fields["stations"], survey.scans, strict=True)
        if one["scan"] is not None
    }
    return StationScans(fields, scans, inputs=[path for path, _ in inputs])


def _placed(loader: Loader, survey: Survey, source: Source, name: str) -> Scan:
    known: Scan | None = loader.known("scan", source)
    found = loader.read_scan(source) if known is None else known
    return replace(found, name=name, world_from_scanner=surveyed_pose(survey, source))
