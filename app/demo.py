"""The demo: register the embedded sample and look at it."""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING

from app.exit_codes import ExitCode
from app.step_bar import StepBar, step_bar
from app.wording import report

if TYPE_CHECKING:
    import viser

    from app.scene import Scene, Stage

log = logging.getLogger(__name__)


def run_demo(*, port: int, browser: bool, quiet: bool) -> ExitCode:
    """Register the sample, serve its scene on loopback, and wait for Ctrl-C."""
    with step_bar(quiet=quiet) as bar:
        stage = sample_stage(bar)
    if not quiet:
        print(report(stage.registration))
    from app.viser_server import address, close_server

    server, scene = open_view(stage, port=port)
    try:
        print(f"Open {address(server)}  (Ctrl-C ends)", flush=True)
        if browser and _has_screen():
            webbrowser.open(address(server))
        threading.Event().wait()
    except KeyboardInterrupt:
        print(file=sys.stderr)
    finally:
        # A terminal sends Ctrl-C to everyone in it, and `make` passes it on once more: the second must not hurt.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        scene.close()
        close_server(server)
    return ExitCode.ACCEPTED


def sample_stage(bar: StepBar) -> Stage:
    """Register the embedded sample."""
    import ladarreg_core as lr
    from app.scene import Stage
    from ladarreg_core.simulate import sample_folder

    folder: Path = sample_folder()
    scan = lr.read_scan(folder / "scan.npz")
    photo = lr.read_photo(next(folder.glob("photo.*")), camera=folder / "camera.json")
    return Stage(scan, photo, lr.register(scan, photo, report=bar.step))


def open_view(stage: Stage, *, port: int, share: float = 1.0) -> tuple[viser.ViserServer, Scene]:
    """Open a server that shows a registration."""
    from app.panel import add_panel
    from app.scene import Scene
    from app.viser_server import open_server

    server = open_server(port=port, label="ladarreg")
    scene = Scene(server, stage)
    scene.draw(share=share)
    add_panel(server, scene, stage, share=share)
    return server, scene


def _has_screen() -> bool:
    """Tell whether a browser could be seen: without a screen, a text browser would take over the terminal."""
    return sys.platform in ("win32", "darwin") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
