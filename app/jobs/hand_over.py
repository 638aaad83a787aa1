"""The hand-over jobs: registered photographs as files for other programs, zipped or in a folder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ladarreg_core.errors import OptionError

from ..session.hand_over import Chosen, chosen_photos, project_scan
from .export import ExportJobs, size_of
from .inputs import Workspace
from .runner import JobContext

if TYPE_CHECKING:
    from ladarreg_core.export.registered_scan import RegisteredScan
    from ladarreg_core.export.targets.target import ExportOptions, Target
    from ladarreg_core.progress import Report
    from ladarreg_core.project.document import Document, PhotoEntry

HAND_OVER = "hand-over"
"""Name of the zip among the exports; ids of photographs have no hyphen."""
Work = Callable[[JobContext], str]


@dataclass(frozen=True, slots=True, kw_only=True)
class Wanted:
    """What a client wants to hand over."""

    photos: tuple[str, ...] | None = None
    """Ids of photographs; None: all that are registered."""
    frame: str = "scanner"
    """Frame of points, models and poses."""
    full: bool = False
    """Whole meshes."""
    crop: str = "none"
    """`photo` leaves out of models what no photograph covers."""
    last_solved: bool = False
    """Whether poses go out that are out of date."""

    @property
    def options(self) -> ExportOptions:
        """The options of the targets.

        Raises:
            OptionError: if a value is unknown.
        """
        from ladarreg_core.export.targets.target import ExportOptions

        return ExportOptions(full=self.full, crop=self.crop)  # type: ignore[arg-type]


class HandOverJobs:
    """Hands the project's registered photographs over to other programs.

    Args:
        workspace: provides the project.
        exports: knows where exports go and which folders may be replaced.
    """

    def __init__(self, workspace: Workspace, exports: ExportJobs) -> None:
        self._workspace, self._exports = workspace, exports

    @property
    def zip_path(self) -> Path:
        """Path of the zip."""
        return self._workspace.session.folder.exports / f"{HAND_OVER}.zip"

    def table(self, wanted: Wanted) -> dict[str, Any]:
        """Return the targets, which of them cannot be written and why, and the photographs that go out or do not.

        Of photographs with cameras alike only one is read: what refuses a target is the lens.

        Raises:
            LadarregError: if the frame is not known, or a file can no longer be read.
        """
        from ladarreg_core.export.targets.registry import TARGETS

        document, options = self._workspace.session.document, wanted.options
        chosen = self._chosen(document, wanted, with_refused=False)
        for_report = self._chosen(document, wanted, with_refused=True)
        handed = self._scan(document, _alike(chosen.entries), wanted, None) if chosen.entries else None
        return {
            "targets": [
                {
                    "name": target.name,
                    "title": target.title,
                    "purpose": target.purpose,
                    "refusal": _refusal(target, handed, options, for_report),
                }
                for target in TARGETS
            ],
            "photos": [{"id": entry.id, "name": entry.source.name} for entry in chosen.entries],
            "left_out": [
                {"id": one.id, "name": one.name, "why": one.why, "is_stale": one.is_stale} for one in chosen.left_out
            ],
        }

    def work(self, names: Sequence[str], wanted: Wanted, folder: Path | None, *, force: bool) -> tuple[Work, str]:
        """Return the work of a job, and the id of the first photograph.

        Args:
            names: the targets.
            wanted: what is handed over.
            folder: an absolute path on the workbench's computer; None: a zip.
            force: replace an earlier export.

        Raises:
            LadarregError: if a target, the frame or an option is unknown, no photograph can be exported, or the folder
                must not be written or replaced.
        """
        from ladarreg_core.export.output_frame import OutputFrame
        from ladarreg_core.export.targets.hand_over import export_files, export_to
        from ladarreg_core.export.targets.registry import targets_of
        from ladarreg_core.export.targets.zip_file import write_zip

        targets, document, options = targets_of(names), self._workspace.session.document, wanted.options
        chosen = self._chosen(document, wanted, with_refused=all(target.shows_refused for target in targets))
        if not chosen.entries:
            reasons = "; ".join(f"{one.name}: {one.why}" for one in chosen.left_out)
            raise OptionError(f"no photograph can be exported ({reasons or 'there is none'})")
        if folder is not None:
            self._exports.check_folder(folder, document, force=force)
        scan = self._workspace.loader.scan(document)
        if scan is None:
            raise OptionError("there is no scan; open one")
        OutputFrame.of(scan, wanted.frame)
        project = self._workspace.session.folder.path

        def work(context: JobContext) -> str:
            handed = self._scan(document, chosen.entries, wanted, context.progress)
            if folder is not None:
                export_to(
                    folder, handed, names, options=options, apart_from=[project], force=force, report=context.progress
                )
                self._exports.record(chosen.entries)
                return f"Wrote {', '.join(names)} into {folder.name}.{_left_out(chosen)}"
            write_zip(
                self.zip_path,
                lambda: export_files(handed, names, options=options, report=context.progress),
                report=context.progress,
            )
            self._exports.record(chosen.entries)
            return f"Wrote a zip of {size_of(self.zip_path)} with {', '.join(names)}.{_left_out(chosen)}"

        return work, chosen.entries[0].id

    def _chosen(self, document: Document, wanted: Wanted, *, with_refused: bool) -> Chosen:
        return chosen_photos(
            self._workspace.loader,
            document,
            wanted.photos,
            last_solved=wanted.last_solved,
            with_refused=with_refused,
        )

    def _scan(
        self, document: Document, entries: Sequence[PhotoEntry], wanted: Wanted, report: Report | None
    ) -> RegisteredScan:
        workspace = self._workspace
        frame: Any = wanted.frame
        return project_scan(workspace.loader, workspace.session.folder, document, entries, frame=frame, report=report)


def _refusal(target: Target, handed: RegisteredScan | None, options: ExportOptions, for_report: Chosen) -> str | None:
    """Return why a target cannot be written; None if it can."""
    if handed is not None:
        return target.refusal(handed, options)
    if target.shows_refused and for_report.entries:
        return None
    reasons = "; ".join(f"{one.name}: {one.why}" for one in for_report.left_out)
    return reasons or "no photograph has an accepted pose, and a refused one is shown by its report only"


def _alike(entries: Sequence[PhotoEntry]) -> list[PhotoEntry]:
    """Return one photograph of each kind of camera."""
    found: dict[tuple[Any, ...], PhotoEntry] = {}
    for entry in entries:
        camera = {} if entry.pose is None else entry.pose.camera
        terms = camera.get("distortion") or ()
        key = (camera.get("model"), camera.get("width"), camera.get("height"), len(terms))
        found.setdefault(key, entry)
    return list(found.values())


def _left_out(chosen: Chosen) -> str:
    if not chosen.left_out:
        return ""
    return f" Left out: {'; '.join(f'{one.name}: {one.why}' for one in chosen.left_out)}."
