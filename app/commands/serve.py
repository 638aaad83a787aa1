"""`ladarreg serve [PROJECT | SURVEY | BATCH | SCAN PHOTO ...]`."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from ..arguments import CameraArguments
from ..exit_codes import ExitCode

if TYPE_CHECKING:
    from ..gateway.options import GatewayOptions
    from ..workbench.given_files import Reading

_TOKEN_VARIABLE = "LADARREG_TOKEN"

EXAMPLES = (
    "ladarreg serve",
    "ladarreg serve room.e57 photo.jpg --focal-px 2900",
    "ladarreg serve sweep1.pcd sweep2.pcd photo.png",
    "ladarreg serve job/survey.json",
    "ladarreg serve results  # of ladarreg batch",
    "# for others on the network, see docs/remote.md:",
    "ladarreg serve my-project --host 0.0.0.0 --certfile a.pem --keyfile b.pem",
)


@dataclass(frozen=True, kw_only=True)
class Arguments(CameraArguments):
    """Arguments of `serve`."""

    inputs: Annotated[
        tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="[PROJECT | SURVEY | BATCH | SCAN PHOTO ...]")
    ] = ()
    """A project folder; a survey.json or a folder with scans and photos, which become stations and photographs of a
    project; the folder of a batch, whose jobs are listed; or a scan and photos, where further scans are accumulated
    with the first."""
    project: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder of a project that is started with a scan and photos."""
    matches: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Manual matches of the photos: JSON, or CSV of points; read where a photo has none yet."""
    initial: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Pose from which the search begins: a pose JSON (scanner or world), registration.json, or transforms.json."""
    folder: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Let clients open files below this folder, and acquisitions watch it."""
    watch: Annotated[tyro.conf.UseAppendAction[tuple[Path, ...]], tyro.conf.arg(metavar="DIR")] = ()
    """Let acquisitions watch this folder, in which a scanner or camera writes; may be repeated."""
    video_device: Annotated[tyro.conf.UseAppendAction[tuple[int, ...]], tyro.conf.arg(metavar="N")] = ()
    """Let acquisitions take photographs with this video device; may be repeated."""
    udp_port: Annotated[tyro.conf.UseAppendAction[tuple[int, ...]], tyro.conf.arg(metavar="N")] = ()
    """Let acquisitions listen on this UDP port for the packets of a spinning lidar; may be repeated."""
    host: str = "127.0.0.1"
    """Address to listen on; any other than the loopback address exposes the workbench, see docs/remote.md."""
    port: int = 8700
    """Port; if it is in use, the next free one. 0: any free port."""
    socket: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Listen on a Unix socket instead, for a reverse proxy, see docs/remote.md; implies --behind-proxy."""
    token: Annotated[str | None, tyro.conf.arg(metavar="TOKEN")] = None
    """Access token, at least 22 characters; safer in LADARREG_TOKEN. Default: a random one, kept for the port."""
    new_token: bool = False
    """Replace the kept tokens: earlier links, and pages that are open, lose access."""
    no_browser: bool = False
    """Print the address, but open no browser."""
    certfile: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """TLS certificate chain, PEM."""
    keyfile: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Private key of the certificate, PEM."""
    upload_limit_mb: int = 2048
    """Largest upload, MB."""
    cache_mb: int = 640
    """Memory for views, pictures, photos and parts of the model that are kept for reuse, MB; the scan takes its own."""
    behind_proxy: bool = False
    """Trust the X-Forwarded headers of a reverse proxy."""
    allow_host: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="NAME")] = ()
    """Additional host name under which browsers may reach the page; may be repeated."""
    debug: bool = False
    """Print a log, and a traceback on failure."""


def run(arguments: Arguments) -> ExitCode:
    """Open the workbench and serve it until a stop signal."""
    from ..session.isolated_readers import READERS

    READERS.warm()  # in parallel with the imports below
    from ladarreg_core.errors import OptionError

    from ..gateway.login import checked_token
    from ..gateway.options import GatewayOptions
    from ..gateway.server import check_certificate

    # Arguments are checked before a scan is read.
    options = GatewayOptions(
        host=arguments.host,
        port=arguments.port,
        socket=arguments.socket,
        certfile=str(arguments.certfile) if arguments.certfile else None,
        keyfile=str(arguments.keyfile) if arguments.keyfile else None,
        behind_proxy=arguments.behind_proxy,
        allowed_hosts=arguments.allow_host,
    )
    check_certificate(options)
    chosen = arguments.token if arguments.token is not None else os.environ.get(_TOKEN_VARIABLE)
    token = checked_token(chosen) if chosen is not None else None
    for name in ("upload_limit_mb", "cache_mb"):
        if getattr(arguments, name) < 1:
            raise OptionError(f"--{name.replace('_', '-')} is {getattr(arguments, name)}; it must be at least 1")
    if arguments.folder is not None and not arguments.folder.is_dir():
        raise OptionError(f"{arguments.folder}: folder not found; give another with --folder")
    for path in arguments.watch:
        if not path.is_dir():
            raise OptionError(f"{path}: folder not found; give another with --watch")
    _serve(arguments, token, options)
    return ExitCode.ACCEPTED


def _reading(arguments: Arguments) -> Reading:
    """Return what the command line says about the files.

    Raises:
        OptionError: if an option has no meaning, or a file does not exist.
    """
    from ladarreg_core.errors import OptionError
    from ladarreg_core.formats.scans.scan_request import ScanOptions

    from ..workbench.given_files import Reading

    files: dict[str, Path | None] = {}
    for name in ("camera", "matches", "initial"):
        path = getattr(arguments, name)
        if path is not None and not path.exists():
            raise OptionError(f"{path}: no such file; give another")
        files[name] = None if path is None else Path(os.path.abspath(path))
    names = {"camera_name": "name", "camera_model": "model"}
    camera = {
        names.get(name, name): value
        for name, value in arguments.photo_options.items()
        if value is not None and name not in ("camera", "temperature_unit")
    }
    return Reading(
        scan_options=ScanOptions(**arguments.scan_options).given(),
        camera_options=camera,
        temperature_unit=arguments.temperature_unit,
        camera=files["camera"],
        matches=files["matches"],
        initial=files["initial"],
    )


def _serve(arguments: Arguments, token: str | None, options: GatewayOptions) -> None:
    from ..process_resources import limit_arenas
    from ..stop_signals import StopSignals
    from ..workbench.acquisition.watchable import Watchable
    from ..workbench.launch import TokenChoice, batch_given, open_workbench, serve_and_close

    limit_arenas()
    stop = StopSignals()
    stop.listen()
    watchable = Watchable(arguments.watch, arguments.video_device, arguments.udp_port)
    batch = batch_given(arguments.inputs)
    workbench = open_workbench(
        () if batch else arguments.inputs,
        project=arguments.project,
        reading=_reading(arguments),
        folder=arguments.folder,
        watchable=watchable,
        upload_bytes=arguments.upload_limit_mb << 20,
        cache_bytes=arguments.cache_mb * 1_000_000,
        check=stop.check,
    )
    tokens = TokenChoice(chosen=token, renew=arguments.new_token)
    serve_and_close(
        workbench,
        batch=batch,
        tokens=tokens,
        options=options,
        browser=not arguments.no_browser,
        stop=stop,
        folder=arguments.folder,
        watchable=watchable,
    )
