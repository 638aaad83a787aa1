"""`ladarreg report RESULTS|PROJECT`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from ..arguments import ScanArguments
from ..exit_codes import ExitCode
from ..inputs import timed
from ..progress_bar import ProgressBar, progress_bar

if TYPE_CHECKING:
    from ladarreg_core.project.document import Document, PhotoEntry

EXAMPLES = (
    "ladarreg report results",
    "# of one photo of a project, into a file of its own:",
    "ladarreg report my-project --photo photo.jpg -o report.html",
)


@dataclass(frozen=True, kw_only=True)
class Arguments(ScanArguments):
    """Arguments of `report`."""

    source: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FOLDER")]
    """Folder of results (with a registration.json), or a project."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FILE")] = None
    """HTML file to write; by default report.html in the folder of results, or among the project's exports."""
    inputs: Annotated[list[Path], tyro.conf.arg(metavar="FOLDER")] = field(default_factory=list)
    """Folders with the scan and the photo of the results; they are also looked for beside the results."""
    photo: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Photo of a project with several: its file name, or its id such as p2."""
    temperature_unit: Literal["K", "C", "none"] | None = None
    """Unit of the pixels of a thermal photo whose file does not state it, as it was registered with."""
    trust_edited: bool = False
    """Go on with results that were changed after they were written: given, not verified."""
    force: bool = False
    """Replace FILE if it is a report that ladarreg wrote, unchanged."""
    quiet: bool = False
    """Print no progress."""
    debug: bool = False
    """Print a log, and a traceback on failure."""


def run(arguments: Arguments) -> ExitCode:
    """Write the report of a registration, accepted or not, and print its path."""
    from ladarreg_core.errors import OptionError
    from ladarreg_core.project.storage.folder import is_project

    source = arguments.source
    if not source.is_dir():
        raise OptionError(f"{source}: folder not found; give a folder of results, or a project")
    with progress_bar(quiet=arguments.quiet) as bar:
        if (source / "registration.json").is_file():
            path = _of_results(arguments, bar)
        elif is_project(source):
            path = _of_project(arguments, bar)
        else:
            raise OptionError(
                f"{source} has neither a registration.json nor a project.json; give a folder of results, or a project"
            )
    print(f"Wrote    {path}")
    return ExitCode.ACCEPTED


def _of_results(arguments: Arguments, bar: ProgressBar) -> Path:
    """Write the report of a folder of results, whose inputs are found by their names and hashes."""
    from ladarreg_core.errors import FormatError, OptionError
    from ladarreg_core.export.outputs.saved_results import read_saved_result
    from ladarreg_core.export.report.page import write_report
    from ladarreg_core.storage.atomic_write import replaced_file
    from ladarreg_core.storage.manifest import update_manifest
    from ladarreg_core.storage.replacement import REPORT_FILE

    folder = arguments.source
    if arguments.photo is not None:
        raise OptionError("--photo chooses a photo of a project; a folder of results has one only")
    saved = read_saved_result(folder, trust_edited=arguments.trust_edited)
    scan_path, photo_path = timed("Find inputs", bar, lambda: saved.find(arguments.inputs))
    out = _target(arguments, folder / REPORT_FILE)
    given, unit = arguments.scan_options, arguments.temperature_unit
    scan = timed("Read scan", bar, lambda: saved.read_scan(scan_path, given, report=bar.loading))
    photo = timed("Read photo", bar, lambda: saved.read_photo(photo_path, temperature_unit=unit))
    with replaced_file(out) as new:
        try:
            timed("Write report", bar, lambda: write_report(new, saved.registration, scan, photo, saved.document))
        except (KeyError, TypeError, ValueError, AttributeError):  # fields of other types than those that are written
            raise FormatError(f"{folder / 'registration.json'} is damaged; give an unmodified one") from None
    if out == folder / REPORT_FILE and not arguments.trust_edited:
        update_manifest(folder, [REPORT_FILE])
    return out


def _of_project(arguments: Arguments, bar: ProgressBar) -> Path:
    """Write the report of the shown pose of a project's photo."""
    from ladarreg_core.errors import OptionError
    from ladarreg_core.project.storage.folder import ProjectFolder

    from ..session.exported import exported_pose
    from ..session.loader import Loader

    kept = ProjectFolder(arguments.source)
    try:
        document, loader = kept.read().document, Loader(kept)
        entry = _photo(document, arguments.photo)
        scan = timed("Read scan", bar, lambda: loader.scan(document))
        if scan is None:
            raise OptionError("the project has no scan; open one in the workbench")
        photo = timed("Read photo", bar, lambda: loader.photo(entry))
        pose = timed("Assess", bar, lambda: exported_pose(loader, kept, document, entry, scan))
        out = _target(arguments, kept.exports / f"{entry.id}.html")
        timed("Write report", bar, lambda: pose.write_report(out, scan, photo))
    finally:
        kept.close()
    return out


def _photo(document: Document, name: str | None) -> PhotoEntry:
    """Return the photo of a name or an id; without either, the only one that has a pose.

    Raises:
        OptionError: if there is none, or several.
    """
    from ladarreg_core.errors import OptionError

    found = [entry for entry in document.photos if name in (entry.id, entry.source.name)]
    if name is None:
        found = [entry for entry in document.photos if entry.pose is not None]
    if len(found) == 1:
        return found[0]
    listed = ", ".join(f"{entry.id} ({entry.source.name})" for entry in document.photos)
    if not document.photos:
        raise OptionError("the project has no photo; open one in the workbench")
    if name is None and not found:
        raise OptionError("no photo of the project has a pose; solve one in the workbench")
    wanted = "several photos have a pose" if name is None else f"{len(found)} photos are called {name!r}"
    raise OptionError(f"{wanted}; give one of {listed} with --photo")


def _target(arguments: Arguments, own: Path) -> Path:
    """Return the file to write; a report as the program wrote it may be replaced, by -o with --force only.

    Raises:
        OptionError: if it cannot be written.
        ExportError: if it is not a report as the program wrote it.
    """
    from ladarreg_core.errors import OptionError
    from ladarreg_core.storage.manifest import MANIFEST_FILE
    from ladarreg_core.storage.replacement import require_own_report

    out = own if arguments.out is None else arguments.out
    if not out.parent.is_dir():
        raise OptionError(f"the folder {out.parent} does not exist; create it, or give another file with -o")
    if out.is_dir():
        raise OptionError(f"{out} is a folder; give a file with -o")
    if out.suffix.lower() not in (".html", ".htm"):  # no mistyped option may replace a scan or a photo
        raise OptionError(f"{out} does not end in .html; give an HTML file with -o")
    if out.exists() and arguments.out is not None and not arguments.force:
        raise OptionError(f"{out} exists; give another file, or replace it with --force")
    if arguments.out is not None or (out.parent / MANIFEST_FILE).is_file():  # reports of earlier versions have no seal
        require_own_report(out)
    return out
