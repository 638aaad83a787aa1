"""`ladarreg demo`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from ..exit_codes import ExitCode

if TYPE_CHECKING:
    from ..workbench.workbench import Workbench

_NAME = "Sample"


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Arguments of `demo`."""

    port: int = 8080
    """Port; if it is in use, the next free one. 0: any free port."""
    no_browser: bool = False
    """Print the address, but open no browser."""
    project: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder of the project on the sample."""
    fresh: bool = False
    """Start over; earlier work on the sample stays in the history."""
    debug: bool = False
    """Print a log, and a traceback on failure."""


def run(arguments: Arguments) -> ExitCode:
    """Open the workbench on the embedded sample and register it."""
    from ..session.isolated_readers import READERS

    READERS.warm()  # in parallel with the imports below
    from ladarreg_core.simulate import sample_folder

    from ..gateway.login import new_token
    from ..gateway.options import GatewayOptions
    from ..process_resources import limit_arenas
    from ..stop_signals import StopSignals
    from ..workbench.launch import open_workbench, serve_and_close

    limit_arenas()
    stop = StopSignals()
    stop.listen()
    folder = sample_folder()
    workbench = open_workbench(
        (folder / "scan.npz", next(folder.glob("photo.*"))),
        camera=folder / "camera.json",
        project=arguments.project,
        name=_NAME,
        check=stop.check,
    )
    try:
        _begin(workbench, fresh=arguments.fresh)
    except BaseException:
        workbench.close()
        raise
    options = GatewayOptions(port=arguments.port)
    serve_and_close(workbench, token=new_token(), options=options, browser=not arguments.no_browser, stop=stop)
    return ExitCode.ACCEPTED


def _begin(workbench: Workbench, *, fresh: bool) -> None:
    """Register the sample unless the project already contains work on it."""
    from ladarreg_core.project.history import NOBODY

    shown = workbench.selection.photo
    assert shown is not None, "the sample has a photograph"
    if fresh:
        workbench.start_over(shown.id)
    if fresh or (not shown.picks and not shown.poses):
        workbench.jobs.run("auto", shown.id, NOBODY)
