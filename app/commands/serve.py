"""`ladarreg serve [PROJECT | SCAN PHOTO ...]`."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from ..exit_codes import ExitCode

if TYPE_CHECKING:
    from ..gateway.options import GatewayOptions

_TOKEN_VARIABLE = "LADARREG_TOKEN"


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """What `serve` is told."""

    inputs: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="[PROJECT | SCAN PHOTO ...]")] = ()
    """A project's folder, or a scan and photographs to begin one with; nothing: the last project is offered."""
    project: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Where to keep the project that a scan and photographs begin."""
    folder: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Offer the files below this folder in the page."""
    host: str = "127.0.0.1"
    """Address to listen on; anything but this machine's own opens the workbench to others, see docs/remote.md."""
    port: int = 8700
    """Port; a busy one is replaced by the next, 0 is any."""
    token: Annotated[str | None, tyro.conf.arg(metavar="TOKEN")] = None
    """What opens the page, 12 characters at least; better in LADARREG_TOKEN. None: a random one for each start."""
    no_browser: bool = False
    """Only print the address."""
    certfile: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Certificate chain for TLS, PEM."""
    keyfile: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """The certificate's key, PEM."""
    upload_limit_mb: int = 2048
    """The largest file that a page may send, MB."""
    behind_proxy: bool = False
    """Believe the X-Forwarded headers of a reverse proxy in front."""
    allow_host: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="NAME")] = ()
    """A name, beside this machine's own, by which browsers may ask for the page; may be said again."""
    debug: bool = False
    """Log, and a trace back where something fails."""


def run(arguments: Arguments) -> ExitCode:
    """Open the workbench and serve it until a signal asks to stop."""
    from ..session.isolated_readers import READERS

    READERS.warm()  # it loads the readers while this process loads the rest
    from ladarreg_core.errors import OptionError

    from ..gateway.login import checked_token, new_token
    from ..gateway.options import GatewayOptions
    from ..gateway.server import check_certificate

    # Everything that can be wrong with the words is said before a scan is read.
    options = GatewayOptions(
        host=arguments.host,
        port=arguments.port,
        certfile=str(arguments.certfile) if arguments.certfile else None,
        keyfile=str(arguments.keyfile) if arguments.keyfile else None,
        behind_proxy=arguments.behind_proxy,
        allowed_hosts=arguments.allow_host,
    )
    check_certificate(options)
    chosen = arguments.token if arguments.token is not None else os.environ.get(_TOKEN_VARIABLE)
    token = checked_token(chosen) if chosen is not None else new_token()
    if arguments.upload_limit_mb < 1:
        raise OptionError(f"--upload-limit-mb is {arguments.upload_limit_mb}; it must be 1 at least")
    if arguments.folder is not None and not arguments.folder.is_dir():
        raise OptionError(f"{arguments.folder}: there is no such folder; give another with --folder")
    _serve(arguments, token, options)
    return ExitCode.ACCEPTED


def _serve(arguments: Arguments, token: str, options: GatewayOptions) -> None:
    from ..process_resources import limit_arenas
    from ..stop_signals import StopSignals
    from ..workbench.launch import open_workbench, serve_and_close

    limit_arenas()
    stop = StopSignals()
    stop.listen()
    workbench = open_workbench(
        arguments.inputs,
        project=arguments.project,
        folder=arguments.folder,
        upload_bytes=arguments.upload_limit_mb << 20,
        check=stop.check,
    )
    serve_and_close(workbench, token=token, options=options, browser=not arguments.no_browser, stop=stop)
