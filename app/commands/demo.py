"""`ladarreg demo`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ..exit_codes import ExitCode

EXAMPLES = (
    "ladarreg demo",
    "ladarreg demo --survey",
    "ladarreg demo --acquire",
    "ladarreg demo --port 0 --no-browser",
)


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Arguments of `demo`."""

    port: int = 8080
    """Port; if it is in use, the next free one. 0: any free port."""
    no_browser: bool = False
    """Print the address, but open no browser."""
    project: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder of the project on the sample."""
    acquire: bool = False
    """Scan all around with a simulated pan/tilt unit and line scanner instead, from an empty project."""
    survey: bool = False
    """Open a survey instead: two scans and ten photos of two cameras, to be adjusted together in the step Survey."""
    fresh: bool = False
    """Start over; earlier work on the sample stays in the history."""
    new_token: bool = False
    """Replace the kept tokens: earlier links, and pages that are open, lose access."""
    debug: bool = False
    """Print a log, and a traceback on failure."""


def run(arguments: Arguments) -> ExitCode:
    """Open the workbench on the embedded sample and register it, or on simulated devices."""
    from ..session.isolated_readers import READERS

    READERS.warm()  # in parallel with the imports below
    from ladarreg_core.errors import OptionError
    from ladarreg_core.simulate.sample import sample_survey_folder

    from ..gateway.options import GatewayOptions
    from ..process_resources import limit_arenas
    from ..stop_signals import StopSignals
    from ..workbench.given_files import Reading
    from ..workbench.launch import TokenChoice, open_workbench, serve_and_close
    from ..workbench.sample import SAMPLE_NAME, register_sample, sample_files

    if arguments.acquire and arguments.survey:
        raise OptionError("--acquire and --survey are two samples; give one of them")
    if arguments.fresh and (arguments.acquire or arguments.survey):
        raise OptionError("--fresh starts over with the photo of the sample; give it without --acquire and --survey")
    limit_arenas()
    stop = StopSignals()
    stop.listen()
    if arguments.survey:
        name = f"{SAMPLE_NAME} survey"
        workbench = open_workbench([sample_survey_folder()], project=arguments.project, name=name, check=stop.check)
    elif arguments.acquire:
        workbench = open_workbench((), project=arguments.project, check=stop.check)
        workbench.acquisition.offered = True
    else:
        scan, photo, camera = sample_files()
        workbench = open_workbench(
            (scan, photo),
            reading=Reading(camera=camera),
            project=arguments.project,
            name=SAMPLE_NAME,
            check=stop.check,
        )
        try:
            register_sample(workbench, fresh=arguments.fresh)
        except BaseException:
            workbench.close()
            raise
    options = GatewayOptions(port=arguments.port)
    tokens = TokenChoice(renew=arguments.new_token)
    serve_and_close(workbench, tokens=tokens, options=options, browser=not arguments.no_browser, stop=stop)
    return ExitCode.ACCEPTED
