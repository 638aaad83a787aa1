"""Files of all formats that ask a careless reader to connect somewhere, or to open what does not belong to them."""

from __future__ import annotations

import json
import os
import re
import shutil
import socket
import subprocess
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from testing.attacks.bombs import e57_with_xml
from testing.attacks.mutations import mutated
from testing.files.seed_files import write_seeds

_CHECKOUT = Path(__file__).resolve().parents[2]
_CALLS = "prctl,open,openat,openat2,connect,socket,execve,clone,fork,vfork"
_CODE = (
    sys.prefix, sys.base_prefix, str(_CHECKOUT), "/proc/", "/sys/", "/dev/", "/lib", "/usr/lib", "/etc/ld.so.cache",
)  # fmt: skip
_READ = """
import sys
from contextlib import suppress
from pathlib import Path
from ladarreg_core.errors import LadarregError
from ladarreg_core.formats import describe
from ladarreg_core.formats.isolated import IsolatedReaders
readers = IsolatedReaders()
for path in map(Path, sys.stdin.read().splitlines()):
    with suppress(LadarregError):
        readers.run(describe, path)
readers.close()
"""


class Listener:
    """Counts the connections and datagrams that reach a port of this machine."""

    def __init__(self) -> None:
        self.heard = 0
        self._stream = socket.create_server(("127.0.0.1", 0))
        self.port = self._stream.getsockname()[1]
        self._datagrams = socket.socket(type=socket.SOCK_DGRAM)
        self._datagrams.bind(("127.0.0.1", self.port))
        for listen in (self._accept, self._receive):
            threading.Thread(target=listen, daemon=True).start()

    @property
    def address(self) -> str:
        """Its address on the web."""
        return f"http://127.0.0.1:{self.port}/"

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                self._stream.accept()[0].close()
                self.heard += 1

    def _receive(self) -> None:
        with suppress(OSError):
            while self._datagrams.recv(100):
                self.heard += 1

    def close(self) -> None:
        """Stop listening."""
        self._stream.close()
        self._datagrams.close()


def write_hostile(folder: Path, count: int, address: str) -> list[Path]:
    """Write hostile files of all formats, each into a folder of its own; return them.

    Args:
        folder: an empty folder; `secret` in it is what they would like to read.
        count: how many.
        address: what they would like to connect to.
    """
    secret = folder / "secret"
    secret.write_bytes(b"foreign")
    (folder / "seeds").mkdir()
    seeds = write_seeds(folder / "seeds")
    ours = [seed for seed in seeds if seed.format == "E57"]
    made = []
    for number in range(count):
        seed = ours[number % len(ours)] if number % 10 == 9 else seeds[number % len(seeds)]
        own = folder / f"{number:03d}"
        shutil.copytree(seed.file.parent, own)
        file, damaged = (own / path.relative_to(seed.file.parent) for path in (seed.file, seed.damaged))
        _make_hostile(file, damaged, number // len(seeds) + number, address.encode(), secret)
        made.append(file)
    return made


def _make_hostile(file: Path, damaged: Path, number: int, address: bytes, secret: Path) -> None:
    content = damaged.read_bytes()
    if content.startswith(b"ASTM-E57"):
        _ask_in_xml(damaged, number, address)
    elif number % 4 == 0 and (beside := [path for path in file.parent.iterdir() if path != file and path.is_file()]):
        beside[number % len(beside)].unlink()
        beside[number % len(beside)].symlink_to(secret)
    elif number % 4 == 1 and file.suffix == ".json":
        with suppress(ValueError):
            file.write_text(json.dumps(_pointing(json.loads(file.read_text(encoding="utf-8-sig")), str(secret))))
    elif number % 2:
        spot = content.find(b"<", 8) if b"<" in content else len(content) // 2
        damaged.write_bytes(content[:spot] + _types(address)[number // 2 % 2] + address + content[spot:])
    else:
        damaged.write_bytes(mutated(content, seed=f"{number}"))


def _types(address: bytes) -> tuple[bytes, bytes]:
    return b'<!DOCTYPE a SYSTEM "%sa.dtd">' % address, b'<!DOCTYPE a [<!ENTITY %% b SYSTEM "%sb">%%b;]>' % address


def _ask_in_xml(path: Path, number: int, address: bytes) -> None:
    schema = b' xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance" xsi:schemaLocation="%s %sx.xsd"'
    root = b'<e57Root type="Structure"'
    changes = (root + schema % (address, address), *(one + root for one in _types(address)))
    e57_with_xml(path, lambda xml: xml.replace(root, changes[number % 3]))


def _pointing(value: Any, path: str) -> Any:
    """Return JSON values with each name of a file replaced."""
    if isinstance(value, dict):
        return {name: _pointing(one, path) for name, one in value.items()}
    if isinstance(value, list):
        return [_pointing(one, path) for one in value]
    return path if isinstance(value, str) and re.search(r"\.\w{2,4}$", value) else value


@dataclass(frozen=True, slots=True)
class Traced:
    """What the system calls of reader processes show."""

    confined: int
    """Processes that confined themselves."""
    opened: tuple[str, ...]
    """Files that they opened afterwards, links followed."""
    foreign: tuple[str, ...]
    """Those of them that are neither the program's code nor in the folder of the files."""
    others: tuple[str, ...]
    """Other calls that succeeded: connections, sockets, processes, programs."""


def traced_reading(files: Sequence[Path], folder: Path, log: Path) -> Traced | None:
    """Describe files in reader processes, and return what their system calls show; None: tracing is not permitted.

    Args:
        files: the files.
        folder: the folder that they lie in; what they would like to read there is called `secret`.
        log: where the system calls are written.
    """
    done = subprocess.run(
        ["strace", "-f", "-y", "-e", f"trace={_CALLS}", "-o", log, sys.executable, "-c", _READ],
        cwd=_CHECKOUT, capture_output=True, text=True, input="\n".join(map(str, files)),
    )  # fmt: skip
    if "not permitted" in done.stderr:
        return None
    assert done.returncode == 0, done.stderr
    confined: set[str] = set()
    opened: list[str] = []
    others: list[str] = []
    for line in log.read_text(errors="replace").splitlines():
        process, _, call = line.partition(" ")
        call = call.strip()
        if call.startswith("prctl(PR_SET_SECCOMP") and call.endswith("= 0"):
            confined.add(process)
        elif process in confined and not re.search(r"= -1 |\+\+\+|---|resumed|CLONE_THREAD|PR_SET_NAME", call):
            if call.startswith("open"):
                opened.append(call.rpartition("<")[2].removesuffix(">"))
            else:
                others.append(call)
    inside = os.path.realpath(folder)
    foreign = [path for path in opened if not path.startswith((*_CODE, f"{inside}/")) or path == f"{inside}/secret"]
    return Traced(len(confined), tuple(opened), tuple(foreign), tuple(others))
