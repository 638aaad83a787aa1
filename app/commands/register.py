"""`ladarreg register SCAN PHOTO -o OUT`."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from app.exit_codes import ExitCode
from app.inputs import input_files, print_notes, read_inputs, read_start
from app.step_bar import StepBar, step_bar
from app.thresholds import ThresholdArguments, check_method, register_options
from app.wording import report, verdict

if TYPE_CHECKING:
    from ladarreg_core.photo import Photo
    from ladarreg_core.results import Registration
    from ladarreg_core.scan import Scan


@dataclass(frozen=True, kw_only=True)
class Arguments(ThresholdArguments):
    """What `register` is told."""

    method: Literal["auto", "thesis", "manual"] = "auto"
    """How to register. With --matches, auto is manual and thesis solves the matches."""


def run(arguments: Arguments) -> ExitCode:
    """Read, register, export, and tell the verdict."""
    from ladarreg_core.export.folder import check_folder

    started = time.perf_counter()
    check_folder(arguments.out, force=arguments.force)
    check_method(arguments, arguments.method)
    with step_bar(quiet=arguments.quiet) as bar:
        scan, photo = read_inputs(arguments, bar)
        result = _register(arguments, scan, photo, bar)
        names = _export(arguments, result, scan, photo, bar)
    if arguments.quiet:
        print(verdict(result))
    else:
        print_notes(scan, photo)
        print(report(result))
        print(f"Wrote    {', '.join(names)} in {arguments.out}")
        print(f"Took     {time.perf_counter() - started:.1f} s")
    return ExitCode.ACCEPTED if result.accepted else ExitCode.NOT_ACCEPTED


def _register(arguments: Arguments, scan: Scan, photo: Photo, bar: StepBar) -> Registration:
    import ladarreg_core as lr

    picks, initial = read_start(arguments, scan)
    return lr.register(
        scan,
        photo,
        method=arguments.method,
        picks=picks,
        initial=initial,
        options=register_options(arguments),
        report=bar.step,
    )


def _export(arguments: Arguments, result: Registration, scan: Scan, photo: Photo, bar: StepBar) -> list[str]:
    from ladarreg_core.export.folder import export_registration

    export_registration(
        arguments.out,
        result,
        scan,
        photo,
        inputs=input_files(arguments),
        force=arguments.force,
        report=bar.progress,
    )
    return sorted(path.name for path in arguments.out.iterdir())
