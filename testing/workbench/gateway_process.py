"""A program that serves the tests' small workbench: `python -m testing.workbench.gateway_process FOLDER [PORT]`."""

from __future__ import annotations

import sys
from pathlib import Path

from ladarreg.cli import _set_up_log
from ladarreg.gateway.options import GatewayOptions
from ladarreg.gateway.server import serve_until_interrupted
from ladarreg.gateway.tokens import Tokens
from ladarreg.gateway.viser_backend import close_server, open_locked_server
from ladarreg.stop_signals import StopSignals

from testing.workbench.gateway_driver import TOKEN, CountingWorkbench


def main(folder: str, port: str = "0") -> None:
    stop = StopSignals()
    stop.listen()
    _set_up_log(debug=False)
    server, address = open_locked_server(label="test")
    try:
        serve_until_interrupted(
            CountingWorkbench(Path(folder)),
            lambda: address,
            tokens=lambda port: Tokens(TOKEN, ""),
            options=GatewayOptions(port=int(port)),
            browser=False,
            stop=stop,
        )
    finally:
        close_server(server)


if __name__ == "__main__":
    main(*sys.argv[1:])
