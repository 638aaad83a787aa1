"""A project's scan with its registered photographs, as it is handed over to other programs."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from ladarreg_core.errors import OptionError
from ladarreg_core.progress import Progress, Report

from .exported import exported_pose
from .loader import Loader

if TYPE_CHECKING:
    from ladarreg_core.export.output_frame import FrameName
    from ladarreg_core.export.registered_scan import RegisteredPhoto, RegisteredScan
    from ladarreg_core.project.document import Document, PhotoEntry
    from ladarreg_core.project.storage.folder import ProjectFolder
    from ladarreg_core.scan import Scan


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A photograph that is not handed over."""

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
    """Photographs of a project that can be handed over, and those that cannot."""

    entries: Sequence[PhotoEntry]
    """Those whose pose was accepted or given, or, if reports alone are wanted, refused."""
    left_out: Sequence[LeftOut]
    """The others."""


def chosen_photos(
    loader: Loader,
    document: Document,
    photos: Collection[str] | None,
    *,
    last_solved: bool = False,
    with_refused: bool = False,
) -> Chosen:
    """Return which photographs of a project go out together.

    Args:
        loader: the project's loader.
        document: its document.
        photos: ids of photographs; None: all.
        last_solved: let poses go out that are out of date, as they were solved.
        with_refused: let photographs go out whose pose was refused, for their report.

    Raises:
        LadarregError: if matches are missing or damaged.
    """
    entries, left_out = [], []
    for entry in document.photos:
        if photos is not None and entry.id not in photos:
            continue
        out = _left_out(loader, document, entry, last_solved=last_solved, with_refused=with_refused)
        if out is None:
            entries.append(entry)
        else:
            left_out.append(out)
    return Chosen(entries, left_out)


def _left_out(
    loader: Loader, document: Document, entry: PhotoEntry, *, last_solved: bool, with_refused: bool
) -> LeftOut | None:
    pose, name = entry.pose, entry.source.name
    if pose is None:
        return LeftOut(entry.id, name, "it has no pose; register it")
    if not loader.registration(pose).is_shown and not with_refused:
        return LeftOut(entry.id, name, "its pose was not accepted; register it again")
    stale = "" if last_solved else loader.stale(document, entry, pose)
    if stale:
        why = f"its pose is out of date: {stale}, or export the last solved state"
        return LeftOut(entry.id, name, why, is_stale=True)
    return None


def project_scan(
    loader: Loader,
    folder: ProjectFolder,
    document: Document,
    entries: Sequence[PhotoEntry],
    *,
    frame: FrameName = "scanner",
    report: Report | None = None,
) -> RegisteredScan:
    """Return a project's scan with photographs whose poses were accepted, given or refused.

    Args:
        loader: the project's loader.
        folder: its folder.
        document: its document.
        entries: the photographs.
        frame: of written points and poses.
        report: receives the progress, with the photographs' names.

    Raises:
        OptionError: if there is no scan or photograph, or the frame is `world` and the scan does not state where it
            stands.
        LadarregError: if a file can no longer be read.
    """
    from ladarreg_core.export.output_frame import OutputFrame
    from ladarreg_core.export.registered_scan import RegisteredScan

    if document.scan is None:
        raise OptionError("the project has no scan; open one in the workbench")
    if not entries:
        raise OptionError("no photograph of the project has a pose that can be exported; register one first")
    scan = loader.scan(document)
    assert scan is not None, "it has a file"
    placed = OutputFrame.of(scan, frame)
    photos: list[RegisteredPhoto] = []
    for done, entry in enumerate(entries):
        if report is not None:
            report(Progress(done, len(entries), f"reading {entry.source.name}"))
        photos.append(_photo(loader, folder, document, entry, scan, [one.id for one in photos]))
    return RegisteredScan(
        scan,
        [one for one in photos if one.registration.is_shown],
        folder.source_path(document.scan.path),
        folder.scan_options(document.scan),
        placed,
        [one for one in photos if not one.registration.is_shown],
    )


def _photo(
    loader: Loader, folder: ProjectFolder, document: Document, entry: PhotoEntry, scan: Scan, taken: Sequence[str]
) -> RegisteredPhoto:
    from ladarreg_core.export.registered_scan import RegisteredPhoto, photo_id

    pose, camera = entry.pose, entry.camera.file
    assert pose is not None, "only photographs with a pose are chosen"
    registration = replace(loader.registration(pose), world_from_scanner=scan.world_from_scanner)
    return RegisteredPhoto(
        photo_id(entry.source.name, taken),
        loader.photo(entry),
        registration,
        folder.source_path(entry.source.path),
        None if camera is None else folder.source_path(camera.path),
        entry.photo_options,
        _document_of(loader, folder, document, entry, scan),
    )


def _document_of(
    loader: Loader, folder: ProjectFolder, document: Document, entry: PhotoEntry, scan: Scan
) -> Callable[[], Mapping[str, object]]:
    return lambda: exported_pose(loader, folder, document, entry, scan).document()
