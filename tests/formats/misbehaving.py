"""Readers that misbehave, run in reader processes by the tests."""

from __future__ import annotations

import ctypes
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from ladarreg_core.errors import FormatError
from ladarreg_core.formats import photo_file, read_scan
from ladarreg_core.formats.isolated.messages import message_parts
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.photo import Photo
from ladarreg_core.scan import Scan
from ladarreg_core.scanner import origin


def size_of(path: Path) -> int:
    return path.stat().st_size


def process_id() -> int:
    return os.getpid()


def server_id() -> int:
    """The process that starts one for each file; the same where none is started."""
    return os.getppid() if sys.platform == "linux" else os.getpid()


def breaks_out(path: Path, port: int) -> list[str]:
    """Try what a file that has taken its reader over would try; return what was permitted."""
    attempts: dict[str, Callable[[], object]] = {
        "read a neighbour": lambda: (path.parent / "neighbour").read_bytes(),
        "read a system file": lambda: Path("/etc/passwd").read_bytes(),
        "list a folder": lambda: os.listdir(path.parent),
        "overwrite its file": lambda: path.open("r+b"),
        "write a file": lambda: (path.parent / "new").write_bytes(b"x"),
        "remove its file": path.unlink,
        "rename its file": lambda: path.rename(path.parent / "new"),
        "change its permissions": lambda: path.chmod(0),
        "connect": lambda: socket.create_connection(("127.0.0.1", port), 1),
        "send a datagram": lambda: socket.socket(type=socket.SOCK_DGRAM).sendto(b"x", ("127.0.0.1", port)),
        "use a local socket": lambda: socket.socket(socket.AF_UNIX),
        "start a program": lambda: subprocess.run(["/bin/true"], check=True),
        "become a program": lambda: os.execv("/bin/true", ["true"]),
        "start a process": os.fork,
        "signal its parent": lambda: os.kill(os.getppid(), signal.SIGCONT),
        "trace its parent": lambda: _system_call("ptrace", 16, os.getppid(), 0, 0),
        "outlive its parent": lambda: _system_call("prctl", 1, 0, 0, 0, 0),
        "use io_uring": lambda: _system_call("syscall", 425, 1, ctypes.create_string_buffer(120)),
    }
    done = []
    for name, attempt in attempts.items():
        with suppress(OSError):
            attempt()
            done.append(name)
    return [*done, *([] if path.read_bytes() else ["its file was lost"])]


def _system_call(name: str, *arguments: object) -> None:
    if getattr(ctypes.CDLL(None, use_errno=True), name)(*arguments) < 0:
        raise OSError(ctypes.get_errno(), name)


def echo(value: Any) -> Any:
    return value


def sleeps(path: Path) -> None:
    time.sleep(600)


def computes(path: Path) -> None:
    while True:
        pass


def holds_the_interpreter(path: Path) -> None:
    """Hang in native code that never lets another thread run."""
    if sys.platform == "win32":
        ctypes.PyDLL("kernel32").Sleep(600_000)
    ctypes.PyDLL(None).sleep(600)


def crashes(path: Path) -> None:
    ctypes.string_at(0)


def aborts(path: Path) -> None:
    os.abort()


def exits(path: Path) -> None:
    os._exit(3)


def fails(path: Path) -> None:
    raise ZeroDivisionError("a fault of the program")


def grows(path: Path, megabytes: int) -> int:
    return int(np.ones(megabytes << 20, np.uint8)[-1])


def learns(path: Path, key: str, more: tuple[Path, ...] = ()) -> list[str]:
    """Find where a scanner stood; return which clouds are known then."""
    origin.keep_answers([[key, (1.0, 2.0, 3.0), 0.5, 0.5, True]])
    return [row[0] for row in origin.kept_answers()]


def refuses(path: Path) -> None:
    raise FormatError(f"{path.name}: it is no good; take another")


def returns_code(path: Path) -> Any:
    return refuses


def writes_nonsense(path: Path) -> None:
    """Act like a compromised decoder: write to every open file."""
    for descriptor in range(3, 20):
        try:
            os.write(descriptor, b"\xff" * 4096)
        except OSError:
            continue


def answers_twice(path: Path) -> str:
    """Act like a compromised decoder: append the answer to somebody else's request to one's own."""
    forged = b"".join(message_parts({"answer": "forged", "worn": False, "origins": []}))
    for descriptor in range(3, 20):
        with suppress(OSError):
            os.write(descriptor, b"".join(message_parts({"progress": None})))
            os.write(descriptor, forged + forged)
    return "mine"


def goes_on(path: Path, steps: int, step_s: float, report: Report | None = None) -> int:
    for done in range(steps):
        time.sleep(step_s)
        if report is not None:
            report(Progress(done + 1, steps, "reading"))
    return steps


def marks_time(path: Path, report: Report | None = None) -> None:
    """Hang while repeating the same progress report."""
    while True:
        time.sleep(0.02)
        if report is not None:
            report(Progress(1, 2, "reading"))


def open_files() -> list[str]:
    found = []
    for name in os.listdir("/proc/self/fd"):
        with suppress(FileNotFoundError):  # the one that listed them
            found.append(os.readlink(f"/proc/self/fd/{name}"))
    return found


def environment() -> list[str]:
    return sorted(os.environ)


def read_photo(path: Path, **options: Any) -> Photo:
    """Read a photograph, unless its name requests misbehaviour."""
    _misbehave(path)
    return photo_file.read_photo(path, **options)


def read_scan_or_misbehave(path: Path, *, report: Report | None = None, **asked: Any) -> Scan:
    """Read a scan, unless its name requests misbehaviour."""
    _misbehave(path)
    return read_scan(path, report=report, **asked)


def _misbehave(path: Path) -> None:
    content = path.read_bytes()[-8:]
    if content.endswith(b"crash"):
        ctypes.string_at(0)
    if content.endswith(b"hang"):
        time.sleep(600)
