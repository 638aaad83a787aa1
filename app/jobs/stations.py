"""The jobs on a project's stations: registering them, checking photographs at the others, and the export of all."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from ladarreg_core.errors import LadarregError, OptionError
from ladarreg_core.foundations.progress import Progress
from ladarreg_core.frames import Rigid
from ladarreg_core.project.document import Document, PhotoCheck, PhotoEntry, Survey
from ladarreg_core.project.source import Source
from ladarreg_core.project.station_edits import scans_of, surveyed_pose

from ..session.exported import stations_fault
from .inputs import Workspace
from .runner import JobContext

if TYPE_CHECKING:
    from ladarreg_core.registration.stations.registration import PoseUse
    from ladarreg_core.scan import Scan


class StationJobs:
    """The work of the jobs; each returns a sentence on its result.

    Args:
        workspace: provides the project.
    """

    def __init__(self, workspace: Workspace) -> None:
        self._workspace = workspace

    def require_stations(self) -> Document:
        """Return the document.

        Raises:
            OptionError: if it has no further station.
        """
        document = self._workspace.session.document
        if not document.stations:
            raise OptionError("there is one scan only; add scans of other stations")
        return document

    def require_survey(self) -> tuple[Document, Survey]:
        """Return the document and where its stations stand.

        Raises:
            OptionError: if they have not been registered as they are now.
        """
        document = self._workspace.session.document
        fault = stations_fault(document)
        if fault or document.survey is None:
            raise OptionError(fault)
        return document, document.survey

    def register(self, context: JobContext, poses: PoseUse = "refine") -> str:
        """Register the stations to each other; the scan that is shown is fixed. Rough places are used by `refine`."""
        import ladarreg_core as lr

        document = self.require_stations()
        sources, scans = scans_of(document), []
        for number, (source, name) in enumerate(zip(sources, _names(sources), strict=True)):
            context.progress(Progress(number, len(sources), f"reading {source.name}"))
            scans.append(replace(self._scan(source), name=name))
        if poses == "refine":
            scans = _with_rough_poses(document, scans)
        network = lr.register_scans(scans, poses=poses, seed=document.settings.seed, report=context.progress)
        for source, scan in zip(sources[1:], scans[1:], strict=True):
            self._workspace.loader.station_points(source, scan)
        survey = Survey(scans=sources, fields=json.loads(network.to_json()))
        self._commit(context, f"Register {len(sources)} stations", document, survey)
        done = "confirmed" if poses == "keep" else "registered"
        others = [one.name for one in network.stations if not one.is_verified]
        if not others:
            return f"All {len(sources)} stations are {done}."
        are = "is" if len(others) == 1 else "are"
        return f"{len(sources) - len(others)} of {len(sources)} stations are {done}; {', '.join(others)} {are} not."

    def check_photos(self, context: JobContext) -> str:
        """Verify the poses of the accepted photographs, carried over, by the scans of the other stations."""
        document, survey = self.require_survey()
        entries = [entry for entry in document.photos if self._is_registered(entry)]
        placed = {source: pose for source in scans_of(document) if (pose := surveyed_pose(survey, source)) is not None}
        if not entries:
            raise OptionError("no photograph is registered yet; register one at the scan that is shown")
        wanted = [
            (source, there, entry, placed[own])
            for source, there in placed.items() for entry in entries
            if (own := document.beside(entry).scan) in placed and own is not None and own != source
        ]  # fmt: skip
        if not wanted:
            raise OptionError("no other station is registered to the scan that is shown; register the stations first")
        checks: list[PhotoCheck] = []
        for source, of_scan in groupby(wanted, key=lambda each: each[0]):
            scan = self._scan(source)
            for _, there, entry, here in of_scan:
                said = f"comparing {entry.source.name} with {source.name}"
                context.progress(Progress(len(checks), len(wanted), said))
                checks.append(self._check(entry, source, scan, here.inverse @ there, document.settings.seed))
        self._commit(
            context, "Check photographs at the other stations", document,
            msgspec.structs.replace(survey, checks=tuple(checks)),
        )  # fmt: skip
        good, bad = (sum(check.outcome == outcome for check in checks) for outcome in ("verified", "contradicted"))
        rest = len(checks) - good - bad
        return f"Poses at other stations: {good} verified, {bad} contradicted, {rest} undecidable."

    def _is_registered(self, entry: PhotoEntry) -> bool:
        pose = entry.pose
        loader, document = self._workspace.loader, self._workspace.session.document
        return pose is not None and pose.accepted and not loader.stale(document, entry, pose)

    def _check(self, entry: PhotoEntry, source: Source, scan: Scan, between: Rigid, seed: int) -> PhotoCheck:
        import ladarreg_core as lr

        assert entry.pose is not None, "only photographs with a pose are checked"
        registration = self._workspace.loader.registration(entry.pose)
        photo = replace(self._workspace.loader.photo(entry), camera=registration.camera)
        check = PhotoCheck(
            photo=entry.id,
            name=entry.source.name,
            scan=source,
            pose=entry.pose.name,
            outcome="undecidable",
            sentence="",
        )
        try:
            found = lr.verify_pose(scan, photo, registration.camera_from_scanner @ between, seed=seed)
        except LadarregError as error:
            return msgspec.structs.replace(check, sentence=f"{error}.")
        fraction = None if found.verification is None else float(found.verification.fraction)
        return msgspec.structs.replace(check, outcome=found.outcome, sentence=found.sentence, fraction=fraction)

    def _scan(self, source: Source) -> Scan:
        loader = self._workspace.loader
        found: Scan | None = loader.known("scan", source)
        return loader.read_scan(source) if found is None else found

    def _commit(self, context: JobContext, label: str, before: Document, survey: Survey) -> None:
        def apply(document: Document) -> Document:
            if set(scans_of(document)) != set(scans_of(before)) or document.survey != before.survey:
                raise OptionError("the stations changed while the job ran, so its result was discarded; run it again")
            return msgspec.structs.replace(document, survey=survey)

        self._workspace.session.commit(label, apply, author=context.job.author)


def _with_rough_poses(document: Document, scans: list[Scan]) -> list[Scan]:
    """Return the scans with the rough poses that the operator gave, in the world of the first one."""
    if all(station.rough is None for station in document.stations):
        return scans
    world = scans[0].world_from_scanner or Rigid.identity()
    found = [replace(scans[0], world_from_scanner=world)]
    for station, scan in zip(document.stations, scans[1:], strict=True):
        given = station.rough
        found.append(
            scan if given is None else replace(scan, world_from_scanner=world @ Rigid.from_matrix(given))
        )  # fmt: skip
    return found


def _names(sources: tuple[Source, ...]) -> list[str]:
    """Return the names of scans, each unlike the others."""
    names: list[str] = []
    for source in sources:
        stem = Path(source.name).stem if source.index == 0 else f"{Path(source.name).stem}-{source.index + 1}"
        name, number = stem, 1
        while name in names:
            number += 1
            name = f"{stem} ({number})"
        names.append(name)
    return names
