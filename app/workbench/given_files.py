"""Files of the command line that a project is opened with: scan, photographs, and what is known about them."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from ladarreg_core.errors import LadarregError
from ladarreg_core.export.outputs.saved_results import missing_scans, recorded_scans
from ladarreg_core.formats.documents.own_results import edited_note
from ladarreg_core.project import edits, tie_edits
from ladarreg_core.project.document import CameraGiven
from ladarreg_core.project.drawn import ScanLineEntry
from ladarreg_core.project.history import NOBODY
from ladarreg_core.project.source import Source

from ..session.isolated_readers import READERS
from .files.opening import HowScans
from .files.reading import with_reading

if TYPE_CHECKING:
    from ladarreg_core.project.document import Document, PhotoEntry
    from ladarreg_core.survey.survey import Survey

    from .workbench import Workbench


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """What the command line says about the files; what is not said stays as it is in the project."""

    scan_options: Mapping[str, Any] = field(default_factory=dict)
    """Options of `read_scan` that were given."""
    camera: Path | None = None
    """Camera file of the photographs."""
    camera_options: Mapping[str, Any] = field(default_factory=dict)
    """Fields of `CameraGiven` that were given."""
    temperature_unit: str | None = None
    """Unit of thermal images."""
    matches: Path | None = None
    """Matches of the photographs."""
    initial: Path | None = None
    """Initial pose of the photographs."""
    initials: Mapping[str, Path] = field(default_factory=dict)
    """Initial poses of photographs that have one of their own, by file name."""

    @property
    def is_empty(self) -> bool:
        """Whether nothing was said."""
        return self == Reading()


def add_files(workbench: Workbench, files: Sequence[Path], reading: Reading, check: Callable[[], None]) -> list[str]:
    """Open the files that are not in the project yet, as the command line says that they are to be read.

    What it says of a file that is in the project already, and differs, becomes an edit, which can be undone.

    Args:
        workbench: the workbench.
        files: the scan and the photographs; empty: nothing is opened.
        reading: options that are given for them.
        check: called between files; may raise `Cancelled`.

    Returns:
        Sentences on changes of the project's scan beyond those that were asked for.

    Raises:
        LadarregError: if a file cannot be opened.
    """
    if not files:
        return []
    document, folder = workbench.session.document, workbench.session.folder
    clouds, photos = _sorted(files)
    said: list[str] = []
    if reading.initial is not None and len(clouds) == 1:
        within = [path.parent for path in (*files, reading.initial)]
        more, _ = recorded_scans(reading.initial, clouds[0], within=within)
        clouds += [Path(os.path.abspath(path)) for path in more]
        said = list(filter(None, [missing_scans(reading.initial, clouds[0], more, within=within)]))
    if reading.initial is not None:
        said += filter(None, [edited_note(reading.initial)])
    there = document.scan
    known = [] if there is None else folder.source_files(there)
    further = [path for path in clouds if path not in known]
    if there is None or set(known).isdisjoint(clouds):
        _open(workbench, clouds, "replace", reading)
        if there is not None:
            said.append(
                f"The scan of this project, {there.name}, was replaced by {clouds[0].name}, as given: its matches and "
                "poses are removed, and Undo in the page brings them back. A scan without --project opens a project of "
                "its own"
            )
    elif with_reading(there, reading.scan_options) != there:
        _open(workbench, [*known, *further], "replace", reading)
    elif further:
        _open(workbench, further, "frames", reading)
    for photo in photos:
        check()
        _add_photo(workbench, photo, reading)
    return said


def survey_given(path: Path) -> Survey | None:
    """Return the survey of a `survey.json`, or of a folder with scans and photographs; None: it is something else.

    Raises:
        FormatError: if it is a survey, and has faults.
    """
    from ladarreg_core.batches.photos.photo_list import folder_contents
    from ladarreg_core.survey.survey import Survey
    from ladarreg_core.survey.survey_file import is_survey_file

    if path.is_dir():
        contents = folder_contents(path)
        return Survey.from_folder(path) if contents.scans and contents.photos else None
    return Survey.from_file(path) if is_survey_file(path) else None


def add_survey(workbench: Workbench, survey: Survey, reading: Reading, check: Callable[[], None]) -> None:
    """Open what a survey consists of and the project does not have yet: the first scan, the others as stations, photos.

    Args:
        workbench: the workbench.
        survey: the survey, of files.
        reading: options that are given for the files; those of the survey precede them.
        check: called between files; may raise `Cancelled`.

    Raises:
        LadarregError: if a file cannot be opened.
    """
    from ladarreg_core.project.station_edits import scans_of

    session = workbench.session
    there = {(session.folder.source_path(one.path), one.index) for one in scans_of(session.document)}
    for scan in survey.scans:
        path = Path(os.path.abspath(str(scan.source)))
        if (path, scan.index) in there:
            continue
        check()
        how: HowScans = "replace" if session.document.scan is None else "stations"
        options = {**reading.scan_options, **scan.options, **({"scan_index": scan.index} if scan.index else {})}
        workbench.files.open_scans([(path, path.name)], how, None, options)
    cameras = {one.id: one for one in survey.cameras}
    for photo in survey.photos:
        check()
        camera = cameras[photo.camera]
        named = {"camera_name": "name", "camera_model": "model"}
        stated = {named.get(name, name): value for name, value in camera.options.items() if name != "temperature_unit"}
        own = Reading(
            camera=camera.source if isinstance(camera.source, Path) else reading.camera,
            camera_options={**reading.camera_options, **stated},
            temperature_unit=camera.options.get("temperature_unit", reading.temperature_unit),
        )
        _add_photo(workbench, Path(os.path.abspath(str(photo.source))), own)
    _add_ties(workbench, survey)


def _add_ties(workbench: Workbench, survey: Survey) -> None:
    """Take over the ties and lines that were drawn, those that the project does not have yet."""
    from ladarreg_core.project.station_edits import scans_of

    session = workbench.session
    entries = {session.folder.source_path(one.source.path): one.id for one in session.document.photos}
    ids = {one.id: entries.get(Path(os.path.abspath(str(one.source)))) for one in survey.photos}
    there = {(one.photos, one.uv) for one in session.document.ties}
    lines_there = {(one.photos, one.uv) for one in session.document.lines}
    new = [
        (photos, one) for one in survey.ties
        if None not in (photos := (ids[one.photos[0]], ids[one.photos[1]])) and (photos, one.uv) not in there
    ]  # fmt: skip
    new_lines = [
        (shown, one) for one in survey.lines
        if None not in (shown := tuple(ids[name] for name in one.photos)) and (shown, one.uv) not in lines_there
    ]  # fmt: skip
    if not new and not new_lines:
        return
    known = {(session.folder.source_path(one.path), one.index): one for one in scans_of(session.document)}
    sources = {one.id: known.get((Path(os.path.abspath(str(one.source))), one.index)) for one in survey.scans}

    def edit(document: Document) -> Document:
        for photos, one in new:
            document, _ = tie_edits.with_tie(document, photos, one.uv, one.sigma_px)
        for those, line in new_lines:
            scan = line.in_scan
            source = None if scan is None else sources[scan.scan]
            in_scan = None
            if scan is not None and source is not None:
                in_scan = ScanLineEntry(source=source, xyz=scan.xyz, sigma_m=scan.sigma_m)
            document, _ = tie_edits.with_line(document, those, line.uv, line.sigma_px, in_scan)
        return document

    said = [f"{len(those)} {what}{'' if len(those) == 1 else 's'}"
            for those, what in ((new, "tie"), (new_lines, "line")) if those]  # fmt: skip
    session.commit(f"Draw {' and '.join(said)}", edit, author=NOBODY)


def _open(workbench: Workbench, clouds: Sequence[Path], how: HowScans, reading: Reading) -> None:
    scan = workbench.session.document.scan
    named = {} if scan is None else dict(zip(workbench.session.folder.source_files(scan), scan.names, strict=True))
    files = [(path, named.get(path, path.name)) for path in clouds]
    workbench.files.open_scans(files, how, None, reading.scan_options)


def _sorted(files: Sequence[Path]) -> tuple[list[Path], list[Path]]:
    """Return the scan with the further clouds that are accumulated with it, and the photographs."""
    from ladarreg_core.formats.registry import recognise

    scan, *others = files
    clouds = [scan]
    photos: list[Path] = []
    for path in others:
        try:
            is_scan = recognise(path, kinds=("photo", "scan")).kind == "scan"
        except LadarregError:  # said when it is opened
            is_scan = False
        (clouds if is_scan else photos).append(path)
    return clouds, photos


def _add_photo(workbench: Workbench, photo: Path, reading: Reading) -> None:
    session = workbench.session
    known = (p for p in session.document.photos if session.folder.source_path(p.source.path) == photo)
    entry = next(known, None)
    unit = reading.temperature_unit
    if entry is None or (unit is not None and entry.source.temperature_unit != unit):
        options = {} if unit is None else {"temperature_unit": unit}
        made = workbench.files.open(photo, photo.name, "photo", None, None, options)
        entry = edits.require_photo(session.document, made)
    _set_camera(workbench, entry, reading)
    _set_initial(workbench, entry, photo, reading)
    entry = edits.require_photo(session.document, entry.id)
    if reading.matches is not None and not entry.picks:
        workbench.files.open(reading.matches, reading.matches.name, "matches", entry.id, None)


def _set_camera(workbench: Workbench, entry: PhotoEntry, reading: Reading) -> None:
    camera = CameraGiven(**reading.camera_options)
    if reading.camera is not None:
        size, folder = reading.camera.stat().st_size, workbench.session.folder
        source = Source(path=folder.relative(reading.camera), name=reading.camera.name, size=size)
        camera = msgspec.structs.replace(camera, file=source)
    if camera in (CameraGiven(), entry.camera):
        return
    workbench.queries.check_camera(entry, camera)
    workbench.session.commit(
        f"Camera of {entry.source.name}",
        lambda d: edits.edited_photo(d, entry.id, lambda p: edits.with_camera(p, camera)),
        author=NOBODY,
    )


def _set_initial(workbench: Workbench, entry: PhotoEntry, photo: Path, reading: Reading) -> None:
    from ladarreg_core.formats.documents.pose_file import read_initial

    session = workbench.session
    scan = workbench.loader.scan(session.document.beside(entry))
    file = reading.initials.get(photo.name, reading.initial)
    if file is None or scan is None:
        return
    pose = READERS.run(read_initial, file, scan.world_from_scanner, picture=photo.name)
    rows = tuple(tuple(map(float, row)) for row in pose.matrix)
    if rows == entry.stated_pose:
        return
    session.commit(
        f"Initial pose of {entry.source.name}",
        lambda d: edits.edited_photo(
            d, entry.id, lambda p: msgspec.structs.replace(p, stated_pose=rows, stated_by=file.name)
        ),
        author=NOBODY,
    )
