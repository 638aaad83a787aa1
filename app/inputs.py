"""The input files of the registering commands: reading them, with progress."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, TypeVar

from .arguments import InputArguments, PhotoArguments
from .process_resources import keep_heap_small
from .progress_bar import ProgressBar

if TYPE_CHECKING:
    from ladarreg_core.frames import Rigid
    from ladarreg_core.matches import Pick
    from ladarreg_core.photo import Photo
    from ladarreg_core.scan import Scan

T = TypeVar("T")
_LARGE_SCAN_CELLS = 4_000_000


def read_inputs(arguments: PhotoArguments, bar: ProgressBar) -> tuple[Scan, Photo]:
    """Read the scan and the photo, and report each as a step."""
    import ladarreg_core as lr

    scan = timed("Read scan", bar, lambda: lr.read_scan(arguments.scan, report=bar.loading, **arguments.scan_options))
    spare_heap(scan)
    photo = timed(
        "Read photo",
        bar,
        lambda: lr.read_photo(arguments.photo, **arguments.photo_options),
    )
    return scan, photo


def spare_heap(scan: Scan) -> None:
    """Keep the heap small while a large scan is in memory."""
    if scan.ranges.size > _LARGE_SCAN_CELLS:
        keep_heap_small()


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
        print(f"Note     {note}")
