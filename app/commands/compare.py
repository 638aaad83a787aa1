"""`ladarreg compare SCAN PHOTO -o OUT`."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ..arguments import RegisterArguments, register_options
from ..exit_codes import ExitCode
from ..inputs import print_notes, read_inputs, read_start, with_photo_named, with_recorded_options
from ..json_output import print_written
from ..messages import comparison_report, comparison_verdict
from ..progress_bar import ProgressBar, progress_bar

if TYPE_CHECKING:
    from ladarreg_core.photo import Photo
    from ladarreg_core.registration.comparison import Comparison
    from ladarreg_core.scan import Scan

EXAMPLES = (
    "ladarreg compare room.e57 photo.jpg --camera camera.json -o comparison",
    "ladarreg compare room.e57 photo.jpg --matches matches.json -o comparison",
)


@dataclass(frozen=True, kw_only=True)
class Arguments(RegisterArguments):
    """Arguments of `compare`."""


def run(arguments: Arguments) -> ExitCode:
    """Read, register by every stage, export, and print the table."""
    from ladarreg_core.export.comparison.table import default_of, verdict_of
    from ladarreg_core.export.targets.folder import check_folder

    started = time.perf_counter()
    arguments = with_photo_named(arguments)
    check_folder(arguments.out, force=arguments.force, inputs=arguments.input_files)
    arguments = with_recorded_options(arguments, arguments.initial)
    with progress_bar(quiet=arguments.quiet) as bar:
        scan, photo = read_inputs(arguments, bar, arguments.initial)
        comparison = _compare(arguments, scan, photo, bar)
        names = _export(arguments, comparison, scan, photo, bar)
    if arguments.json:
        print_written(arguments.out, "comparison.json", scan, photo)
    elif arguments.quiet:
        print(comparison_verdict(comparison))
    else:
        print_notes(scan, photo)
        print(comparison_report(comparison, scan))
        print(f"Wrote    {', '.join(names)} in {arguments.out}")
        print(f"Took     {time.perf_counter() - started:.1f} s")
    default = default_of(comparison)
    accepted = default is not None and verdict_of(default) == "accepted"
    return ExitCode.ACCEPTED if accepted else ExitCode.NOT_ACCEPTED


def _compare(arguments: Arguments, scan: Scan, photo: Photo, bar: ProgressBar) -> Comparison:
    from ladarreg_core.registration.comparison import compare

    picks, initial = read_start(arguments, scan)
    return compare(scan, photo, picks=picks, initial=initial, options=register_options(arguments), report=bar.step)


def _export(arguments: Arguments, comparison: Comparison, scan: Scan, photo: Photo, bar: ProgressBar) -> list[str]:
    from ladarreg_core.export.comparison.folder import export_comparison
    from ladarreg_core.storage.manifest import visible_files

    export_comparison(
        arguments.out,
        comparison,
        scan,
        photo,
        inputs=arguments.input_files,
        read_with=arguments.read_with,
        force=arguments.force,
        report=bar.progress,
    )
    return visible_files(arguments.out)
