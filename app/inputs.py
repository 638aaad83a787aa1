"""The input files of the registering commands: reading them, with progress."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from .arguments import InputArguments, PhotoArguments
from .messages import one_line
from .process_resources import keep_freed_memory, keep_heap_small, return_memory
from .progress_bar import ProgressBar

if TYPE_CHECKING:
    from ladarreg_core.frames import Rigid
    from ladarreg_core.matches import Pick
    from ladarreg_core.photo import Photo
    from ladarreg_core.scan import Scan

T = TypeVar("T")
A = TypeVar("A", bound=PhotoArguments)
_CAMERA = ("camera", "focal_px", "focal_mm", "sensor_mm", "camera_model")
_LARGE_SCAN_CELLS = 4_000_000


def read_inputs(arguments: PhotoArguments, bar: ProgressBar) -> tuple[Scan, Photo]:
    """Read the scan and the photo, and report each as a step."""
    import ladarreg_core as lr

    scan = timed("Read scan", bar, lambda: lr.read_scan(arguments.scan, report=bar.loading, **arguments.scan_options))
    suit_heap(scan)
    photo = timed(
        "Read photo",
        bar,
        lambda: lr.read_photo(arguments.photo, **arguments.photo_options),
    )
    return scan, photo


def with_recorded_options(arguments: A, *results: Path | None) -> A:
    """Return arguments with the options that earlier results record of the same scan and photo, where none is given.

    Args:
        arguments: the arguments of a command.
        results: files that may be results, such as an initial pose.
    """
    from ladarreg_core.saved_results import recorded_options

    found: dict[str, Any] = {}
    for path in filter(None, results):
        found = recorded_options(path, arguments.scan, arguments.photo) | found
    default = {field.name: field.default for field in fields(arguments)}
    if any(getattr(arguments, name) != default[name] for name in _CAMERA):
        found = {name: value for name, value in found.items() if name not in _CAMERA}
    words: dict[str, Any] = {
        name: ",".join(map(str, value)) if isinstance(value, tuple) else value for name, value in found.items()
    }
    taken: dict[str, Any] = {n: value for n, value in words.items() if getattr(arguments, n) == default[n]}
    return replace(arguments, **taken)


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
    from ladarreg_core.formats.matches_file import read_matches
    from ladarreg_core.formats.pose_file import read_initial

    picks = read_matches(arguments.matches, scan) if arguments.matches else None
    initial = None
    if arguments.initial:
        initial = read_initial(arguments.initial, scan.world_from_scanner, picture=arguments.photo.name)
    return picks, initial


def timed(name: str, bar: ProgressBar, work: Callable[[], T]) -> T:
    """Do work, and report it as a step."""
    from ladarreg_core.progress import Step

    started = time.perf_counter()
    result = work()
    bar.step(Step(name, time.perf_counter() - started))
    return result


def print_notes(scan: Scan, photo: Photo) -> None:
    """Print the readers' notes on the files."""
    for note in (*scan.notes, *photo.notes):
        print(f"Note     {one_line(note)}")
