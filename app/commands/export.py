"""`ladarreg export RESULT --to TARGETS -o OUT`."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeAlias

import tyro

from ..arguments import ScanArguments
from ..exit_codes import ExitCode
from ..inputs import read_results, suit_heap, timed
from ..progress_bar import ProgressBar, progress_bar

if TYPE_CHECKING:
    from ladarreg_core.export.registered_scan import Registered, RegisteredPhoto
    from ladarreg_core.export.targets.pipeline import Source
    from ladarreg_core.export.targets.stations import StationScans
    from ladarreg_core.export.targets.target import Target
    from ladarreg_core.project.document import Document
    from ladarreg_core.project.storage.folder import ProjectFolder

    from ..session.exported import Chosen

EXAMPLES = (
    "ladarreg export results --to colmap,laz,report -o handover",
    "# several photos on the same scan, or all that were accepted, together:",
    "ladarreg export results-1 results-2 --to e57 -o handover --root data",
    "ladarreg export my-project --to e57,ros -o handover --frame world",
    "ladarreg export --list",
)
_LIST = "list"
_Paths: TypeAlias = list[Path]
_Names: TypeAlias = list[str]
"""Named here, since the field `list` hides the type within the class."""


@dataclass(frozen=True, kw_only=True)
class Arguments(ScanArguments):
    """Arguments of `export`."""

    results: Annotated[tyro.conf.Positional[_Paths], tyro.conf.arg(metavar="RESULT")] = field(default_factory=list)
    """Folder of results, several, a folder of many photos or of a survey, a project, or a folder of stations."""
    to: Annotated[str | None, tyro.conf.arg(metavar="TARGETS")] = None
    """Targets, separated by commas; list prints them."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="OUT")] = None
    """Output folder, with a folder for each target; an existing one is refused, but see --force."""
    scan: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """The scan's file, if it is not found beside the results; recognised by its SHA-256."""
    scan_index: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Index of the scan in a file with several, for results that do not record it."""
    photo: Annotated[tyro.conf.UseAppendAction[_Names], tyro.conf.arg(metavar="PHOTO")] = field(default_factory=list)
    """Of a project: a photo to export, by its file name or id such as p2; of results: a photo's file. Repeatable."""
    root: Annotated[tyro.conf.UseAppendAction[_Paths], tyro.conf.arg(metavar="FOLDER")] = field(default_factory=list)
    """Folder where the scan and the photos are looked for, too. Repeatable."""
    frame: Literal["scanner", "world"] = "scanner"
    """Coordinates of points, models and poses; world: those of the survey, less a stated offset."""
    full: bool = False
    """Write whole meshes instead of those reduced by error."""
    crop: Literal["none", "photo"] = "none"
    """photo: leave out of models what no photo covers."""
    trust_edited: bool = False
    """Go on with results that were changed after they were written: given, not verified."""
    last_solved: bool = False
    """Of a project: export poses that are out of date, as they were solved."""
    temperature_unit: Literal["K", "C", "none"] | None = None
    """Unit of the pixels of a thermal photo, for results that do not record it."""
    force: bool = False
    """Replace OUT if it contains an earlier export and nothing else; any other folder is never touched."""
    quiet: bool = False
    """Print nothing but what was left out."""
    debug: bool = False
    """Print a log, and a traceback on failure."""
    list: bool = False
    """List the targets with what each is for, and exit."""


def run(arguments: Arguments) -> ExitCode:
    """Open the results with their inputs, and write the targets."""
    from ladarreg_core.errors import OptionError
    from ladarreg_core.export.outputs.saved_results import is_saved_result
    from ladarreg_core.export.outputs.station_folder import is_station_folder
    from ladarreg_core.export.targets.folder import check_folder
    from ladarreg_core.export.targets.pipeline import export_to, photographed
    from ladarreg_core.export.targets.registry import targets_of
    from ladarreg_core.export.targets.stations import StationScans
    from ladarreg_core.export.targets.target import ExportOptions
    from ladarreg_core.project.storage.folder import ProjectFolder, is_project

    if arguments.list or arguments.to == _LIST:
        print(_table())
        return ExitCode.ACCEPTED
    missing = [
        name
        for name, value in (("RESULT", arguments.results), ("--to", arguments.to), ("--out", arguments.out))
        if not value
    ]
    if missing:
        raise OptionError(f"missing {', '.join(missing)}; see ladarreg export --help, or --list for the targets")
    given, arguments = arguments.results, _with_accepted_photos(arguments)
    assert arguments.to is not None
    assert arguments.out is not None
    started = time.perf_counter()
    targets = targets_of([name.strip() for name in arguments.to.split(",") if name.strip()])
    first = arguments.results[0]
    project = is_project(first) and not is_saved_result(first)
    stations = is_station_folder(first)
    apart = [first] if project else []
    check_folder(arguments.out, force=arguments.force, inputs=[] if project else arguments.results, apart_from=apart)
    left_out = ""
    with progress_bar(quiet=arguments.quiet) as bar, ExitStack() as stack:
        if project:
            folder = ProjectFolder(first)
            stack.callback(folder.close)
            sources, chosen = _of_project(arguments, folder, targets, bar)
            left_out = "".join(f"Left out {one.name}: {one.why}\n" for one in chosen.left_out)
        elif stations:
            sources = [_of_stations(arguments, first)]
        else:
            sources = [_of_results(arguments, given, targets, bar)]
        for handed in photographed(sources):
            for one in handed.scans:
                suit_heap(one.scan)
        export_to(
            arguments.out,
            sources,
            [target.name for target in targets],
            options=ExportOptions(full=arguments.full, crop=arguments.crop),
            apart_from=apart,
            force=arguments.force,
            report=bar.progress,
        )
    print(left_out, end="")
    for source in sources:
        if isinstance(source, StationScans) and source.mark:
            print(f"Poses    {source.mark}: the folder was changed after it was written")
    if not arguments.quiet:
        for handed in photographed(sources):
            for photo in (*handed.photos, *handed.refused):
                print(f"Photo    {photo.id}: {_state(photo)}")
            print(f"Frame    {handed.frame.sentence}")
        print(f"Wrote    {', '.join(target.name for target in targets)} in {arguments.out}")
        print(f"Took     {time.perf_counter() - started:.1f} s")
    return ExitCode.ACCEPTED


def _with_accepted_photos(arguments: Arguments) -> Arguments:
    """Return arguments with the accepted photos of a folder with many in place of that folder."""
    from ladarreg_core.batches.photos.folder import is_batch_folder
    from ladarreg_core.batches.photos.photo_summary import accepted_folders

    results = [
        found
        for path in arguments.results
        for found in (accepted_folders(path, trust_edited=arguments.trust_edited) if is_batch_folder(path) else [path])
    ]
    return replace(arguments, results=results)


def _of_stations(arguments: Arguments, folder: Path) -> StationScans:
    """Return the stations of a folder."""
    from ladarreg_core.errors import OptionError
    from ladarreg_core.export.outputs.station_folder import read_station_folder

    if len(arguments.results) > 1:
        raise OptionError("a folder of stations is exported by itself; for photos, give their results")
    return read_station_folder(folder, trust_edited=arguments.trust_edited)


def _state(photo: RegisteredPhoto) -> str:
    result = photo.registration
    if not result.accepted:
        return photo.mark or "not accepted"
    evidence = {"image": "verified on the image", "statistics": "on matches only"}.get(result.evidence, result.evidence)
    return f"{result.caveat or 'accepted'}, {evidence}"


def _of_results(arguments: Arguments, given: Sequence[Path], targets: Sequence[Target], bar: ProgressBar) -> Registered:
    """Return results on one scan or those of a survey, whose inputs are found by their names and hashes.

    Args:
        arguments: the arguments, with folders of results of one photograph each.
        given: the folders as they were given, surveys among them.
        targets: the targets.
        bar: receives the progress.
    """
    from ladarreg_core.errors import OptionError
    from ladarreg_core.export.outputs.placed_scans import placed_scans
    from ladarreg_core.export.outputs.saved_results import registered_results
    from ladarreg_core.export.targets.pipeline import require_shown

    saved = read_results(arguments.results, trust_edited=arguments.trust_edited)
    if arguments.last_solved:
        raise OptionError("--last-solved is for projects; a folder of results is as it was solved")
    files = [Path(name) for name in arguments.photo]
    for file in [*files, *([arguments.scan] if arguments.scan else [])]:
        if not file.is_file():
            raise OptionError(f"{file}: file not found; --photo and --scan give the files that results were made of")
    require_shown([one.photo_name for one in saved if not one.registration.is_shown], targets)
    return timed(
        "Read inputs",
        bar,
        lambda: registered_results(
            saved,
            placed=placed_scans(given, trust_edited=arguments.trust_edited),
            folders=[*files, *arguments.root],
            scan_file=arguments.scan,
            scan_options=arguments.scan_options,
            temperature_unit=arguments.temperature_unit,
            frame=arguments.frame,
            option="--root, or the file itself with --scan or --photo",
            report=bar.loading,
        ),
    )


def _of_project(
    arguments: Arguments, folder: ProjectFolder, targets: Sequence[Target], bar: ProgressBar
) -> tuple[Sequence[Source], Chosen]:
    """Return what of a project is exported, and which photographs of it."""
    from ladarreg_core.errors import OptionError

    from ..session.exported import chosen_photos, project_sources
    from ..session.loader import Loader

    if len(arguments.results) > 1:
        raise OptionError("a project is exported by itself; give one project, or several folders of results")
    if arguments.scan or arguments.root:
        raise OptionError("--scan and --root are for folders of results; a project knows its files")
    document, loader = folder.read().document, Loader(folder)
    photos = {_photo_id(document, name) for name in arguments.photo} or None
    chosen = chosen_photos(loader, document, photos, targets=targets, last_solved=arguments.last_solved)
    if (photos is not None or not chosen.entries) and chosen.left_out:
        raise OptionError(f"nothing was written: {chosen.reasons}")
    alone = len(chosen.entries) == 1 and [target.name for target in targets] == ["results"]
    sources = timed(
        "Read inputs",
        bar,
        lambda: project_sources(
            loader,
            folder,
            document,
            chosen.entries,
            targets,
            frame=arguments.frame,
            written_into=arguments.out if alone else None,
            report=bar.loading,
        ),
    )
    return sources, chosen


def _photo_id(document: Document, name: str) -> str:
    """Return the id of a project's photo.

    Raises:
        OptionError: if there is none of this name or id, or several.
    """
    from ladarreg_core.errors import OptionError

    found = [entry.id for entry in document.photos if name in (entry.id, entry.source.name)]
    if len(found) != 1:
        listed = ", ".join(f"{entry.id} ({entry.source.name})" for entry in document.photos) or "none"
        raise OptionError(f"{len(found)} photos are called {name!r}; the project has {listed}")
    return found[0]


def _table() -> str:
    from ladarreg_core.export.targets.registry import TARGETS

    width = max(len(target.name) for target in TARGETS)
    return "\n".join(f"{target.name:<{width}}  {target.title}: {target.purpose}" for target in TARGETS)
