"""The input files of the registering commands: reading them, with progress."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from .arguments import InputArguments, PhotoArguments
from .messages import one_line
from .process_resources import keep_freed_memory, keep_heap_small, return_memory
from .progress_bar import ProgressBar

if TYPE_CHECKING:
    from ladarreg_core.export.outputs.saved_results import SavedResult
    from ladarreg_core.export.registered_scan import RegisteredScan
    from ladarreg_core.frames import Rigid
    from ladarreg_core.matches import Pick
    from ladarreg_core.photo import Photo
    from ladarreg_core.scan import Scan

T = TypeVar("T")
A = TypeVar("A", bound=PhotoArguments)
_CAMERA = ("camera", "focal_px", "focal_mm", "sensor_mm", "camera_model")
_LARGE_SCAN_CELLS = 4_000_000


def read_inputs(
    arguments: PhotoArguments, bar: ProgressBar, *results: Path | None, soon: Callable[[], object] = lambda: None
) -> tuple[Scan, Photo]:
    """Read the scan and the photo side by side, and report each as a step.

    Args:
        arguments: the arguments of a command, after `with_recorded_options`.
        bar: receives the steps.
        results: the files that were given to `with_recorded_options`; the scan's notes name the clouds that they were
            registered on and that are not there.
        soon: loads, meanwhile, the modules that the command needs next.
    """
    from ladarreg_core.formats.photo_file import begin_photo
    from ladarreg_core.formats.registry import begin_scan
    from ladarreg_core.foundations.parallel import OtherCore

    with (
        OtherCore() as other_core,
        begin_photo(arguments.photo, **arguments.photo_options) as begun_photo,
        begin_scan(arguments.scan, **arguments.scan_options) as begun_scan,
    ):
        of_photo = other_core.begin(begun_photo.result)
        other_core.begin(soon)
        scan = timed("Read scan", bar, lambda: begun_scan.result(bar.loading))
        suit_heap(scan)
        given = list(filter(None, results))
        missing = [*_missing_scans(arguments, *given), *_edited(*given)]
        scan = replace(scan, notes=(*scan.notes, *missing)) if missing else scan
        photo = timed("Read photo", bar, of_photo.result)
    return scan, photo


def _missing_scans(arguments: PhotoArguments, *results: Path) -> list[str]:
    """Return notes on the clouds that results were registered on and that are not there."""
    if not results:
        return []
    from ladarreg_core.export.outputs.saved_results import missing_scans

    return [said for path in results if (said := missing_scans(path, arguments.scan, arguments.more or ()))]


def _edited(*results: Path) -> list[str]:
    """Return notes on results that were changed after they were written, and whose pose is taken all the same."""
    if not results:
        return []
    from ladarreg_core.formats.documents.own_results import edited_note

    return [said for path in results if (said := edited_note(path))]


def with_recorded_options(arguments: A, *results: Path | None) -> A:
    """Return arguments with the options that earlier results record of the same scan and photo, where none is given.

    Args:
        arguments: the arguments of a command.
        results: files that may be results, such as an initial pose.
    """
    given = list(filter(None, results))
    if not given:
        return arguments
    from ladarreg_core.export.outputs.saved_results import recorded_options, recorded_scans

    found: dict[str, Any] = {}
    for path in given:
        found = recorded_options(path, arguments.scan, arguments.photo) | found
        if not arguments.more and (more := recorded_scans(path, arguments.scan)[0]):
            arguments = replace(arguments, more=tuple(more))
    default = {field.name: field.default for field in fields(arguments)}
    if any(getattr(arguments, name) != default[name] for name in _CAMERA):
        found = {name: value for name, value in found.items() if name not in _CAMERA}
    words: dict[str, Any] = {
        name: ",".join(map(str, value)) if isinstance(value, tuple) else value for name, value in found.items()
    }
    taken: dict[str, Any] = {n: value for n, value in words.items() if getattr(arguments, n) == default[n]}
    return replace(arguments, **taken)


def with_photo_named(arguments: A) -> A:
    """Return arguments with the one picture among several files as the photo, and all others as scans.

    Raises:
        OptionError: if several of them, or none, are photos.
    """
    from ladarreg_core.errors import OptionError
    from ladarreg_core.formats.registry import recognise

    if not arguments.more:
        return arguments
    files = [arguments.scan, arguments.photo, *arguments.more]
    photos = [file for file in files if recognise(file, kinds=("photo", "scan")).kind == "photo"]
    if len(photos) != 1:
        found = ", ".join(photo.name for photo in photos) or "none"
        raise OptionError(
            f"of the {len(files)} files {len(photos)} are photos ({found}); give one photo and the scans of one "
            "standpoint, or the pairs of a rig by ladarreg register --rig"
        )
    first, *more = (file for file in files if file != photos[0])
    return replace(arguments, scan=first, photo=photos[0], more=tuple(more))


def suit_heap(scan: Scan) -> None:
    """Keep the heap small while a large scan is in memory, and fast otherwise."""
    if scan.ranges.size > _LARGE_SCAN_CELLS:
        keep_heap_small()
    else:
        keep_freed_memory()


def spare_heap(scan: Scan) -> None:
    """Return what the work on a large scan has freed, which may be hundreds of megabytes."""
    if scan.ranges.size > _LARGE_SCAN_CELLS:
        return_memory()


def read_start(arguments: InputArguments, scan: Scan) -> tuple[list[Pick] | None, Rigid | None]:
    """Read the manual matches and the initial pose; None for each that was not given."""
    from ladarreg_core.formats.documents.matches_file import read_matches
    from ladarreg_core.formats.documents.pose_file import read_initial

    picks = read_matches(arguments.matches, scan) if arguments.matches else None
    initial = None
    if arguments.initial:
        initial = read_initial(arguments.initial, scan.world_from_scanner, picture=arguments.photo.name)
    return picks, initial


def read_results(paths: Sequence[Path], *, trust_edited: bool = False) -> list[SavedResult]:
    """Read folders of results, without the files that they were made of.

    Raises:
        OptionError: if a path is no such folder.
        FormatError: if one is damaged.
    """
    from ladarreg_core.errors import OptionError
    from ladarreg_core.export.outputs.saved_results import is_saved_result, read_saved_result

    for path in paths:
        if not is_saved_result(path):
            what = "has neither a registration.json nor a project.json" if path.is_dir() else "is not a folder"
            raise OptionError(f"{path} {what}; give folders of results, or one project")
    return [read_saved_result(path, trust_edited=trust_edited) for path in paths]


def pixels_of(words: Sequence[str]) -> list[tuple[float, float]]:
    """Return the pixels (u, v) that --at gives.

    Raises:
        OptionError: if one is not two finite numbers.
    """
    from ladarreg_core.errors import OptionError

    found = []
    for text in words:
        try:
            u, v = (float(word) for word in text.split(","))
        except ValueError:
            u = v = math.nan
        if not (math.isfinite(u) and math.isfinite(v)):
            raise OptionError(f"--at is {text[:40]!r}; give a pixel as two numbers, such as --at 812,400")
        found.append((u, v))
    return found


class ResultArguments(Protocol):
    """Arguments that give results on one scan."""

    @property
    def results(self) -> list[Path]:
        """Their folders."""

    @property
    def scan(self) -> Path | None:
        """The scan's file."""

    @property
    def root(self) -> list[Path]:
        """Where the files are looked for, too."""

    @property
    def trust_edited(self) -> bool:
        """Whether results that were changed are read, too."""


def read_on_one_scan(arguments: ResultArguments, bar: ProgressBar) -> RegisteredScan:
    """Read results on one scan, with the files that they were made of.

    Raises:
        OptionError: if they are on several scans.
        LadarregError: if one is damaged, or a file is not found.
    """
    from ladarreg_core.errors import OptionError
    from ladarreg_core.export.outputs.saved_results import registered_results
    from ladarreg_core.export.registered_scan import RegisteredScan

    for path in [arguments.scan] if arguments.scan else []:
        if not path.is_file():
            raise OptionError(f"{path}: file not found; --scan gives the file that the results were made of")
    found = registered_results(
        read_results(arguments.results, trust_edited=arguments.trust_edited),
        folders=arguments.root,
        scan_file=arguments.scan,
        option="--root, or the file itself with --scan",
        report=bar.loading,
    )
    if not isinstance(found, RegisteredScan):
        raise OptionError("the results are on several scans; give those on one of them")
    suit_heap(found.scan)
    return found


def timed(name: str, bar: ProgressBar, work: Callable[[], T]) -> T:
    """Do work, and report it as a step."""
    from ladarreg_core.results.steps import Step

    started = time.perf_counter()
    result = work()
    bar.step(Step(name, time.perf_counter() - started))
    return result


def print_notes(scan: Scan, photo: Photo) -> None:
    """Print the readers' notes on the files."""
    for note in (*scan.notes, *photo.notes):
        print(f"Note     {one_line(note)}")
