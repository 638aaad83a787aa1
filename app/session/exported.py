"""A photograph's pose with everything that an export or a report of it states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ladarreg_core.errors import OptionError

from .loader import Loader

if TYPE_CHECKING:
    from ladarreg_core.matches import Pick
    from ladarreg_core.photo import Photo
    from ladarreg_core.project.document import Document, PhotoEntry
    from ladarreg_core.project.storage.folder import ProjectFolder
    from ladarreg_core.quality.assessment import Assessment
    from ladarreg_core.results import Registration
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

    def document(self) -> dict[str, Any]:
        """Return its `registration.json`.

        Raises:
            ExportError: if an input cannot be read again.
        """
        from ladarreg_core.export.json import registration_document

        document = registration_document(
            self.registration, assessment=self.assessment, inputs=self.inputs, read_with=self.read_with
        )
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
    stale, then = loader.stale(document, entry, pose), loader.solved_on(pose)
    return ExportedPose(
        replace(loader.registration(pose), world_from_scanner=scan.world_from_scanner),
        loader.assessment(scan, pose),
        inputs,
        [reading, entry.photo_options],
        [pick.as_pick() for pick in (then if stale and then is not None else entry.picks)],
        rests_on(entry, pose, then, document.clouds),
    )
