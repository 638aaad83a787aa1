"""`ladarreg acquire PLAN -o FOLDER`."""

from __future__ import annotations

import sys
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from ..exit_codes import ExitCode
from ..messages import one_line
from ..progress_bar import progress_bar

if TYPE_CHECKING:
    from ladarreg_core.acquisition.plan import Plan
    from ladarreg_core.acquisition.runs.runner import Run, RunEvent, StraysKept

    from ..progress_bar import ProgressBar
    from ..stop_signals import StopSignals

_FOR_EVER_S = 3600.0
EXAMPLES = (
    "ladarreg acquire plan.json --example",
    "ladarreg acquire plan.json --dry-run",
    "ladarreg acquire plan.json -o run",
    "ladarreg acquire plan.json -o run --resume",
)


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Arguments of `acquire`."""

    plan: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="PLAN")]
    """Plan of the run, JSON; see docs/acquisition.md."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FOLDER")] = None
    """Folder of the run: its pieces, and in the end scan.npz."""
    resume: bool = False
    """Go on with the run in FOLDER at the first missing piece."""
    force: bool = False
    """Replace the run in FOLDER if it contains nothing else; it is set aside until the new one is complete."""
    dry_run: bool = False
    """Print stops, overlaps, cells and duration; no device is needed, and nothing moves."""
    example: bool = False
    """Write a plan to edit into PLAN, with simulated devices, and end."""
    quiet: bool = False
    """Print no progress."""
    debug: bool = False
    """Print a log, and a traceback on failure."""


def run(arguments: Arguments) -> ExitCode:
    """Drive the devices through the plan."""
    from ladarreg_core.acquisition.plan_reading import read_plan
    from ladarreg_core.errors import OptionError

    if arguments.example:
        return _write_example(arguments.plan)
    plan = read_plan(arguments.plan)
    if arguments.dry_run:
        print(_described(plan))
        return ExitCode.ACCEPTED
    if arguments.out is None:
        raise OptionError("no folder for the run is given; give -o FOLDER, or --dry-run")
    return _acquire(plan, arguments, arguments.out)


def _acquire(plan: Plan, arguments: Arguments, out: Path) -> ExitCode:
    from ladarreg_core.acquisition.runs.connected import connected
    from ladarreg_core.acquisition.runs.run_folder import RunWriter
    from ladarreg_core.foundations.shell_command import shell_command

    from ..stop_signals import StopSignals

    signals = StopSignals()
    folder = RunWriter.begin(out, plan, resume=arguments.resume, force=arguments.force)
    try:
        for fault in folder.faults:
            print(f"ladarreg: {one_line(fault)}", file=sys.stderr)
        print(f"Plan       {_described(plan)}")
        with connected(plan) as devices:
            print(f"Unit       {one_line(devices.unit.identity.model)}")
            if devices.line_scanner is not None:
                print(f"Scanner    {one_line(devices.line_scanner.identity.model)}")
            with progress_bar(quiet=arguments.quiet) as bar:
                watch = _Watch(bar)
                acquisition = devices.run(plan, folder, watch.see)
                watch.run = acquisition
                signals.listen()
                threading.Thread(target=_stop_on_signal, args=(signals, acquisition), daemon=True).start()
                complete = acquisition.go()
    finally:
        folder.close()
    again = shell_command(["ladarreg", "acquire", arguments.plan, "-o", out, "--resume"])
    if watch.fault:
        print(f"ladarreg: {one_line(watch.fault)}", file=sys.stderr)
    if not complete:
        print(f"Stopped    {watch.done} of {acquisition.total} pieces are kept; go on with: {again}")
        return ExitCode.FAILED if watch.fault else ExitCode.INTERRUPTED
    return _composed(out, quiet=arguments.quiet)


def _composed(out: Path, *, quiet: bool) -> ExitCode:
    from ladarreg_core.acquisition.composition.panorama import add_to_run, compose

    with progress_bar(quiet=quiet) as bar:
        panorama = compose(out, report=bar.progress)
        add_to_run(out, panorama)
    rows, columns = panorama.scan.shape
    print(f"Panorama   {rows} x {columns} cells, {panorama.scan.valid.mean():.0%} with returns: {out / 'scan.npz'}")
    for note in panorama.scan.notes:
        print(f"Note       {one_line(note)}")
    for reason in panorama.reasons:
        print(f"Refused    {one_line(reason)}")
    return ExitCode.ACCEPTED if panorama.accepted else ExitCode.NOT_ACCEPTED


class _Watch:
    """Shows the events of a run; a fault asks whether to go on, or ends the run where nobody can answer."""

    def __init__(self, bar: ProgressBar) -> None:
        self.run: Run | None = None
        self.fault = ""
        self.done = 0
        self._bar = bar

    def see(self, event: RunEvent) -> None:
        """Show an event."""
        from ladarreg_core.acquisition.runs.runner import (
            Compared,
            Ended,
            Paused,
            PieceKept,
            Repeated,
            Resumed,
            StraysKept,
        )
        from ladarreg_core.foundations.progress import Progress

        if isinstance(event, PieceKept):
            self.done = event.done
            label = f"piece {event.done} of {event.total}, {_duration(event.seconds_left)} left"
            self._bar.progress(Progress(event.done, event.total, label))
        elif isinstance(event, Paused) and event.fault:
            self.fault = event.reason
            threading.Thread(target=self._ask, daemon=True).start()
        elif isinstance(event, Compared):
            print(f"\nClosure    {one_line(event.closure.sentence())}")
        elif isinstance(event, Repeated):
            print(f"\nladarreg: {one_line(event.reason)}", file=sys.stderr)
        elif isinstance(event, StraysKept):
            print(f"\nladarreg: {one_line(_said_of_strays(event))}", file=sys.stderr)
        elif isinstance(event, Resumed):
            self.fault = ""
        elif isinstance(event, Ended):
            self.done = event.done

    def _ask(self) -> None:
        assert self.run is not None
        if not sys.stdin.isatty():
            self.run.stop()
            return
        print(f"\nladarreg: {one_line(self.fault)}", file=sys.stderr)
        print("Enter goes on, Ctrl-C ends the run; all pieces so far are kept.", file=sys.stderr)
        if sys.stdin.readline():
            self.run.resume()


def _said_of_strays(event: StraysKept) -> str:
    names = ", ".join(event.names)
    return (
        f"{names} came before the unit had arrived at stop {event.index} and count for no stop; copies lie in "
        f"stray/{event.index:03d} of the run"
    )


def _stop_on_signal(signals: StopSignals, acquisition: Run) -> None:
    while not signals.wait(_FOR_EVER_S):
        pass
    acquisition.stop()


def _write_example(path: Path) -> ExitCode:
    from ladarreg_core.acquisition.plan import example_plan, write_plan
    from ladarreg_core.errors import ExportError

    if path.exists():
        raise ExportError(f"{path} exists already; give a new name")
    write_plan(path, example_plan())
    print(f"Wrote      {path}: half a turn with simulated devices; ladarreg devices names your ports")
    return ExitCode.ACCEPTED


def _described(plan: Plan) -> str:
    from ladarreg_core.acquisition.runs.stops import forecast

    ahead = forecast(plan)
    parts = [f"{plan.mode}, {ahead.stops:,} stops, {ahead.pieces:,} pieces"]
    if ahead.cells is not None:
        parts.append(f"about {ahead.cells:,} cells")
    if ahead.overlap is not None:
        parts.append(f"overlap {ahead.overlap[0]:.0%} across, {ahead.overlap[1]:.0%} down")
    triggers = {"scanner": plan.scanner.trigger, "camera": plan.camera.trigger if plan.camera is not None else None}
    parts += [f"{name} triggered by {one_line(str(each))}" for name, each in triggers.items() if each is not None]
    parts.append(f"about {_duration(ahead.seconds)}")
    return ", ".join(parts)


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
