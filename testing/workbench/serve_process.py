"""`ladarreg serve` as a process of its own, and a page's connection to it."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from websockets.sync.client import ClientConnection

from testing.workbench.gateway_driver import TOKEN, Running, hear
from testing.workbench.processes import restore_stop_signals

CHECKOUT = Path(__file__).parents[2]


class At:
    """The port of a gateway in another process, as `Running` needs it."""

    def __init__(self, port: int) -> None:
        self.port = port


class Server:
    """A running `ladarreg serve` with a logged-in browser."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert "://" in line, process.communicate(timeout=60)[1]
        self.process = process
        self.address = line.split()[1]
        self.there = Running(None, At(urlsplit(self.address).port or 0))  # type: ignore[arg-type]
        self.there.enter()

    def end(self, seconds: float = 60) -> str:
        """Wait until the process has ended and return what it printed on stderr."""
        return self.process.communicate(timeout=seconds)[1]


PATIENT_PROGRAM = """
from ladarreg import stop_signals
from ladarreg.gateway import server
stop_signals.ONE_REQUEST_S, server._GRACE_S = {one_request_s}, {grace_s}
from ladarreg.cli import entry_point
entry_point()
"""
"""The program with other times: within which stop signals are one request, and for which requests are waited for."""


def start(
    project: Path, *words: str, program: Sequence[str] = ("-m", "ladarreg"), **surroundings: str
) -> subprocess.Popen[str]:
    """Start the program on a project, new or not."""
    return subprocess.Popen(
        [sys.executable, *program, "serve", "--project", str(project), "--port", "0", "--no-browser", *words],
        cwd=CHECKOUT,
        env=os.environ | {"LADARREG_TOKEN": TOKEN, "LADARREG_HOME": str(project.parent)} | surroundings,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=restore_stop_signals if os.name == "posix" else None,
    )


@contextmanager
def serving(project: Path, *words: str, program: Sequence[str] = ("-m", "ladarreg")) -> Iterator[Server]:
    """Run the program on a project, and kill it at the end if it is still running."""
    process = start(project, *words, program=program)
    try:
        yield Server(process)
    finally:
        process.kill()
        process.communicate()


def ask(page: ClientConnection, do: str, **fields: Any) -> dict[str, Any]:
    """Send a command and return the reply."""
    page.send(json.dumps({"id": 1, "do": do, **fields}))
    while "reply" not in (message := hear(page)):
        pass
    return message


def name_of(project: Path) -> str:
    """Return the name in a project's file."""
    return str(json.loads((project / "project.json").read_bytes())["name"])


def is_listening(there: Running) -> bool:
    """Whether a gateway accepts connections."""
    try:
        socket.create_connection(("127.0.0.1", there.port), timeout=60).close()
    except OSError:
        return False
    return True


def begin_upload(there: Running) -> socket.socket:
    """Begin an upload that is never completed."""
    line = socket.create_connection(("127.0.0.1", there.port), timeout=60)
    target = there.access.within("/upload?what=scan")
    head = f"POST {target} HTTP/1.1\r\nHost: localhost\r\nOrigin: http://localhost\r\nX-File-Name: a.e57\r\n"
    line.sendall(f"{head}Cookie: {there.access.cookie}\r\nContent-Length: 100000\r\n\r\nabc".encode())
    return line
