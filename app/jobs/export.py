"""The export job: photographs and stations written to targets, as a zip, into a folder, or a report as a page."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from msgspec import MsgspecError, Struct, json

from ladarreg_core.errors import ExportError, LadarregError, OptionError
from ladarreg_core.project.edits import require_photo
from ladarreg_core.project.station_edits import scans_of
from ladarreg_core.storage.atomic_write import write_bytes

from ..session.exported import Chosen, beside_one_scan, chosen_photos, exported_pose, project_sources, stations_fault
from .inputs import Workspace
from .runner import JobContext

if TYPE_CHECKING:
    from ladarreg_core.export.output_frame import FrameName
    from ladarreg_core.export.targets.pipeline import Source as ExportSource
    from ladarreg_core.export.targets.target import Crop, ExportOptions, Target
    from ladarreg_core.project.document import Document, PhotoEntry, PoseEntry
    from ladarreg_core.project.source import Source

    from ..slices.events import ExportReadyEvent

log = logging.getLogger(__name__)
ALL = "all"
"""Name, in place of a photograph's id, of the zip of several; ids of photographs are a letter and a number."""
Ending = Literal["zip", "html"]
NOTHING_MEASURED = "nothing was measured yet; pick points with the tool Measure"


@dataclass(frozen=True, slots=True, kw_only=True)
class Wanted:
    """What is exported."""

    targets: Sequence[str] = ()
    """Names of targets."""
    photos: Sequence[str] | None = None
    """Ids of photographs; None: all that the targets can show."""
    frame: FrameName = "scanner"
    """Frame of points, models and poses."""
    full: bool = False
    """Whole meshes."""
    crop: Crop = "none"
    """`photo` leaves out of models what no photograph covers."""
    last_solved: bool = False
    """Include poses that are out of date, as they were solved."""

    @property
    def options(self) -> ExportOptions:
        """The options of the targets."""
        from ladarreg_core.export.targets.target import ExportOptions

        return ExportOptions(full=self.full, crop=self.crop)

    @property
    def name(self) -> str:
        """The name of the file that it becomes, without its ending: a photograph's id, or `ALL`."""
        return self.photos[0] if self.photos is not None and len(self.photos) == 1 else ALL


@dataclass(frozen=True, slots=True)
class Export:
    """An export that can begin."""

    label: str
    """Label of the job."""
    photo: str
    """Id of the first photograph; empty without any."""
    work: Callable[[JobContext], str]
    """Writes it and returns a sentence."""
    event: ExportReadyEvent | None
    """Sent to all clients once it is written; None: it goes into a folder."""


class _Exported(Struct, frozen=True):
    """What the pose of a photograph was exported to: a record in the project's folder of exports."""

    pose: str
    """Its name, see `_name_of`."""
    targets: dict[str, Literal["scanner", "world"]]
    """Targets, and the frame of each."""


class ExportJobs:
    """Exports what a project has.

    Args:
        workspace: provides the project.
    """

    def __init__(self, workspace: Workspace) -> None:
        self._workspace = workspace
        self._exported: dict[str, _Exported] | None = None

    def table(self, wanted: Wanted) -> dict[str, Any]:
        """Return all targets, which cannot be written and why, and the photographs that are exported or left out.

        Of photographs with cameras alike only one is read: what refuses a target is the lens.

        Raises:
            LadarregError: if a target or the frame is unknown, or a file can no longer be read.
        """
        from ladarreg_core.export.targets.registry import TARGETS, targets_of

        document = self._workspace.session.document
        chosen = self._chosen(document, wanted, targets_of(wanted.targets) if wanted.targets else ())
        refusals = self._refusals(document, wanted)
        return {
            "targets": [
                {
                    "name": target.name,
                    "title": target.title,
                    "purpose": target.purpose,
                    "refusal": refusals[target.name],
                }
                for target in TARGETS
            ],
            "photos": [{"id": entry.id, "name": entry.source.name} for entry in chosen.entries],
            "left_out": [
                {"id": one.id, "name": one.name, "why": one.why, "is_stale": one.is_stale} for one in chosen.left_out
            ],
        }

    def begin(self, wanted: Wanted, folder: Path | None, *, force: bool) -> Export:
        """Return an export into a folder of the workbench's computer, or as a zip if there is none.

        Raises:
            LadarregError: if a target, the frame or a photograph is unknown, nothing can be exported, or the folder
                must not be written or replaced.
        """
        from ladarreg_core.export.output_frame import OutputFrame
        from ladarreg_core.export.targets.measurements import MeasurementList
        from ladarreg_core.export.targets.pipeline import export_files, export_to
        from ladarreg_core.export.targets.registry import targets_of
        from ladarreg_core.export.targets.stations import StationScans
        from ladarreg_core.export.targets.zip_file import write_zip

        targets, document, options = targets_of(wanted.targets), self._workspace.session.document, wanted.options
        names = list(dict.fromkeys(wanted.targets))
        for photo in wanted.photos or ():
            require_photo(document, photo)
        if folder is not None:
            self.check_folder(folder, document, force=force)
        chosen = self._chosen(document, wanted, targets)
        wants_photo = any(not {StationScans, MeasurementList} & set(target.reads) for target in targets)
        if not chosen.entries and wants_photo:
            raise OptionError(f"no photograph can be exported ({chosen.reasons or 'there is none'})")
        wants_stations = any(StationScans in target.reads for target in targets)
        if not chosen.entries and wants_stations and (fault := stations_fault(document)):
            raise OptionError(fault)
        if any(MeasurementList in target.reads for target in targets) and not document.measurements:
            raise OptionError(NOTHING_MEASURED)
        scan = self._workspace.loader.scan(beside_one_scan(self._workspace.loader, document, chosen.entries)[0])
        if scan is None:
            raise OptionError("there is no scan; open one")
        OutputFrame.of(scan, wanted.frame)
        alone = names == ["results"] and len(chosen.entries) == 1

        def work(context: JobContext) -> str:
            sources = self._sources(document, chosen.entries, targets, wanted, context, folder if alone else None)
            if folder is not None:
                export_to(
                    folder,
                    sources,
                    names,
                    options=options,
                    apart_from=[self._workspace.session.folder.path],
                    force=force,
                    report=context.progress,
                )
                said = f"Wrote {', '.join(names)} into {folder.name}."
            else:
                path = self._path(wanted.name, "zip")
                write_zip(
                    path,
                    lambda: export_files(sources, names, options=options, report=context.progress),
                    report=context.progress,
                )
                said = f"Wrote a zip of {_size_of(path)} with {', '.join(names)}."
            self._record(chosen.entries, wanted)
            return f"{said} Left out: {chosen.reasons}." if chosen.left_out else said

        label = f"Export {', '.join(names)}" if folder is None else f"Export into {folder.name}"
        event = _event(wanted, "zip") if folder is None else None
        return Export(label, chosen.entries[0].id if chosen.entries else "", work, event)

    def begin_page(self, photo: object) -> Export:
        """Return an export of a photograph's report as a page, which states itself if its pose is refused or stale.

        Raises:
            LadarregError: if the photograph is unknown, or has no pose.
        """
        document, loader = self._workspace.session.document, self._workspace.loader
        entry = require_photo(document, photo)
        document = document.beside(entry)
        if entry.pose is None:
            raise OptionError("there is no pose to report on; solve first")

        def work(context: JobContext) -> str:
            scan = loader.scan(document)
            if scan is None:
                raise OptionError("there is no scan; open one")
            pose = exported_pose(loader, self._workspace.session.folder, document, entry, scan)
            context.check()
            path = self._path(entry.id, "html")
            pose.write_report(path, scan, loader.photo(entry))
            return f"Wrote a report of {_size_of(path)}."

        return Export("Report", entry.id, work, _event(Wanted(targets=["report"], photos=[entry.id]), "html"))

    def file(self, name: str, ending: Ending) -> tuple[Path, str] | None:
        """Return the last zip or report of a photograph (or `ALL`), and its download name; None: there is none."""
        document = self._workspace.session.document
        entry = document.photo(name)
        if entry is None and name != ALL:
            return None
        words = re.sub(
            r"[^A-Za-z0-9._-]+", "-", f"{document.name}-{Path(entry.source.name).stem if entry else 'export'}"
        ).strip("-.")
        path = self._path(ALL if entry is None else entry.id, ending)
        saved = f"{words[:80] or 'registration'}{'-report.html' if ending == 'html' else '.zip'}"
        return (path, saved) if path.is_file() else None

    def exported(self, entry: PhotoEntry) -> dict[str, FrameName]:
        """Return the targets that the shown pose of a photograph was exported to, and the frame of each."""
        known = self._known_exports().get(entry.id)
        is_shown = known is not None and entry.pose is not None and known.pose == _name_of(entry.pose)
        return dict(known.targets) if known is not None and is_shown else {}

    @property
    def record(self) -> object:
        """What was exported; as long as it is the same object, `exported` is the same."""
        return self._known_exports()

    def check_folder(self, folder: Path, document: Document, *, force: bool) -> None:
        """Refuse a folder that must not be written or replaced.

        Raises:
            LadarregError: naming the reason.
        """
        from ladarreg_core.export.targets.folder import check_folder

        if not folder.is_absolute():
            raise OptionError(f"{folder} is not an absolute path; give one", field="folder")
        project = self._workspace.session.folder
        try:
            check_folder(folder, force=force, inputs=self._files_of(document), apart_from=[project.path])
        except LadarregError as error:
            error.field = "folder"
            raise

    def _chosen(self, document: Document, wanted: Wanted, targets: Sequence[Target]) -> Chosen:
        loader = self._workspace.loader
        return chosen_photos(loader, document, wanted.photos, targets=targets, last_solved=wanted.last_solved)

    def _refusals(self, document: Document, wanted: Wanted) -> dict[str, str | None]:
        """Return why each target cannot be written; None for those that can."""
        from ladarreg_core.export.registered_scan import RegisteredScan
        from ladarreg_core.export.targets.measurements import MeasurementList
        from ladarreg_core.export.targets.pipeline import refusal
        from ladarreg_core.export.targets.registry import TARGETS
        from ladarreg_core.export.targets.stations import StationScans

        fault = stations_fault(document)
        plain = [target for target in TARGETS if RegisteredScan in target.reads and not target.shows_refused]
        registered = self._chosen(document, wanted, plain)
        sources: list[ExportSource] = [] if fault else [StationScans({}, {})]
        if registered.entries:  # of stations nothing is read for this
            one_a_camera = _alike(registered.entries)
            photographs_only = [target for target in plain if StationScans not in target.reads]
            sources += self._sources(document, one_a_camera, photographs_only, wanted, None, None)
        found: dict[str, str | None] = {}
        for target in TARGETS:
            if MeasurementList in target.reads:
                found[target.name] = None if document.measurements else NOTHING_MEASURED
            elif target.shows_refused:
                chosen = self._chosen(document, wanted, [target])
                found[target.name] = None if chosen.entries else chosen.reasons or "there is no photograph"
            elif any(isinstance(one, target.reads) for one in sources):
                found[target.name] = refusal(target, sources, wanted.options)
            elif RegisteredScan in target.reads:
                found[target.name] = registered.reasons or "there is no photograph with an accepted pose"
            else:
                found[target.name] = fault
        return found

    def _sources(
        self,
        document: Document,
        entries: Sequence[PhotoEntry],
        targets: Sequence[Target],
        wanted: Wanted,
        context: JobContext | None,
        written_into: Path | None,
    ) -> list[ExportSource]:
        return project_sources(
            self._workspace.loader,
            self._workspace.session.folder,
            document,
            entries,
            targets,
            frame=wanted.frame,
            written_into=written_into,
            report=None if context is None else context.progress,
        )

    def _path(self, name: str, ending: Ending) -> Path:
        return self._workspace.session.folder.exports / f"{name}.{ending}"

    def _record(self, entries: Iterable[PhotoEntry], wanted: Wanted) -> None:
        """Record what the shown poses of photographs were exported to; it is known after a restart, too."""
        written = dict.fromkeys(wanted.targets, wanted.frame)
        new = {
            entry.id: _Exported(pose=_name_of(entry.pose), targets={**self.exported(entry), **written})
            for entry in entries
            if entry.pose is not None
        }
        self._exported = {**self._known_exports(), **new}
        try:
            write_bytes(self._record_path, json.encode(self._exported))
        except (ExportError, OSError) as error:
            log.warning("exports are not recorded: %s", error)

    def _known_exports(self) -> dict[str, _Exported]:
        """Return of each photograph which pose was exported last, and to what."""
        if self._exported is None:
            try:
                self._exported = json.decode(self._record_path.read_bytes(), type=dict[str, _Exported])
            except (OSError, MsgspecError):
                self._exported = {}
        return self._exported

    @property
    def _record_path(self) -> Path:
        return self._workspace.session.folder.exports / "exported.json"

    def _files_of(self, document: Document) -> list[Path]:
        """Return all files that the document refers to."""
        sources: list[Source | None] = [*scans_of(document)]
        for entry in document.photos:
            sources += [entry.source, entry.camera.file]
        folder = self._workspace.session.folder
        return [path for source in sources if source is not None for path in folder.source_files(source)]


def _event(wanted: Wanted, ending: Ending) -> ExportReadyEvent:
    url = f"export/{wanted.name}.{ending}"
    return {"event": "export_ready", "targets": list(wanted.targets), "name": wanted.name, "url": url}


def _alike(entries: Sequence[PhotoEntry]) -> list[PhotoEntry]:
    """Return one photograph of each kind of camera."""
    found: dict[tuple[Any, ...], PhotoEntry] = {}
    for entry in entries:
        camera = {} if entry.pose is None else entry.pose.camera
        terms = camera.get("distortion") or ()
        key = (camera.get("model"), camera.get("width"), camera.get("height"), len(terms))
        found.setdefault(key, entry)
    return list(found.values())


def _size_of(path: Path) -> str:
    """Return the size of a file, in words."""
    count = path.stat().st_size
    return f"{count / 1e6:.1f} MB" if count >= 1e5 else f"{count / 1e3:.0f} kB"


def _name_of(pose: PoseEntry) -> str:
    """Return the name of a pose's arrays, which every pose has for itself, with that of the ranges it holds for."""
    return " ".join(filter(None, [pose.name, pose.ranges]))
