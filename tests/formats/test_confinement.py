"""Reader processes are confined: what takes one over opens nothing else, connects nowhere and starts nothing."""

from __future__ import annotations

import errno
import os
import platform
import re
import shutil
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from ladarreg_core.errors import LadarregError
from ladarreg_core.formats import describe
from ladarreg_core.formats.isolated import IsolatedReaders, confinement
from ladarreg_core.formats.isolated.confinement import _NUMBERS, filter_of
from testing.attacks.bombs import e57_with_xml
from testing.attacks.mutations import mutated
from testing.files.seed_files import write_seeds
from tests.formats import misbehaving

MEANS = dict(confinement())
CONFINED = pytest.mark.skipif(
    not all(state.startswith("yes") for state in MEANS.values()), reason=f"this system has not all of it: {MEANS}"
)


@pytest.fixture(scope="module")
def readers() -> Iterator[IsolatedReaders]:
    found = IsolatedReaders()
    yield found
    found.close()


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
        self._stream.close()
        self._datagrams.close()


@pytest.fixture
def listener() -> Iterator[Listener]:
    found = Listener()
    yield found
    found.close()


@CONFINED
def test_a_reader_that_was_taken_over_can_do_nothing(
    readers: IsolatedReaders, tmp_path: Path, listener: Listener
) -> None:
    path = tmp_path / "a file.e57"
    path.write_bytes(b"its content")
    (tmp_path / "neighbour").write_bytes(b"of somebody else")
    # In this process all of it is permitted; what harms is left out.
    assert readers.run(misbehaving.breaks_out, path, listener.port) == []
    assert sorted(os.listdir(tmp_path)) == ["a file.e57", "neighbour"]
    assert listener.heard == 0


@pytest.mark.slow
def test_files_of_every_format_are_described_as_in_this_process(readers: IsolatedReaders, tmp_path: Path) -> None:
    for seed in write_seeds(tmp_path):
        assert said_of(seed.file, readers) == said_of(seed.file), seed.name


def said_of(path: Path, readers: IsolatedReaders | None = None) -> Any:
    """The description of a file, or why it is refused."""
    try:
        return describe(path) if readers is None else readers.run(describe, path)
    except LadarregError as error:
        return type(error), str(error)


def hostile(path: Path, number: int, address: bytes) -> None:
    """Change a file so that a careless reader asks an address."""
    types = (b'<!DOCTYPE a SYSTEM "%sa.dtd">' % address, b'<!DOCTYPE a [<!ENTITY %% b SYSTEM "%sb">%%b;]>' % address)
    schema = b' xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance" xsi:schemaLocation="%s %sx.xsd"'
    root, content = b'<e57Root type="Structure"', path.read_bytes()
    if content.startswith(b"ASTM-E57"):
        changes = (root + schema % (address, address), types[0] + root, types[1] + root)
        e57_with_xml(path, lambda xml: xml.replace(root, changes[number % 3]))
    elif number % 2:
        spot = content.find(b"<", 8) if b"<" in content else len(content) // 2
        path.write_bytes(content[:spot] + types[number // 2 % 2] + address + content[spot:])
    else:
        path.write_bytes(mutated(content, seed=f"{number}"))


@pytest.mark.slow
def test_nobody_hears_of_fifty_hostile_files(readers: IsolatedReaders, tmp_path: Path, listener: Listener) -> None:
    seeds = write_seeds(tmp_path)
    ours = [seed for seed in seeds if seed.format == "E57"]
    for number in range(50):
        seed = ours[number % len(ours)] if number < 9 else seeds[number % len(seeds)]
        content = seed.damaged.read_bytes()
        hostile(seed.damaged, number, f"http://127.0.0.1:{listener.port}/".encode())
        for describing in (lambda path: readers.run(describe, path), describe):  # the second is not confined
            with suppress(LadarregError):
                describing(seed.file)
        seed.damaged.write_bytes(content)
    assert listener.heard == 0
    with suppress(OSError):  # the listener listens
        socket.create_connection(("127.0.0.1", listener.port)).close()
    for _ in range(100):
        if listener.heard:
            return
        threading.Event().wait(0.02)
    pytest.fail("the listener is deaf")


READ = """
import sys
from contextlib import suppress
from pathlib import Path
from ladarreg_core.errors import LadarregError
from ladarreg_core.formats import describe
from ladarreg_core.formats.isolated import IsolatedReaders
readers = IsolatedReaders()
for path in map(Path, sys.argv[1:]):
    with suppress(LadarregError):
        readers.run(describe, path)
readers.close()
"""


@CONFINED
@pytest.mark.slow
@pytest.mark.skipif(shutil.which("strace") is None, reason="strace is not installed")
def test_system_calls_show_no_connection_and_no_foreign_file(tmp_path: Path, checkout: Path) -> None:
    (tmp_path / "seeds").mkdir()
    files = [seed.file for seed in write_seeds(tmp_path / "seeds")][::3]
    calls = "prctl,open,openat,openat2,connect,socket,execve,clone,fork,vfork"
    done = subprocess.run(
        ["strace", "-f", "-y", "-e", f"trace={calls}", "-o", tmp_path / "log", sys.executable, "-c", READ, *files],
        cwd=checkout, capture_output=True, text=True,
    )  # fmt: skip
    if "not permitted" in done.stderr:
        pytest.skip("tracing is not permitted here")
    assert done.returncode == 0, done.stderr
    confined: set[str] = set()
    opened: list[str] = []
    for line in (tmp_path / "log").read_text(errors="replace").splitlines():
        process, _, call = line.partition(" ")
        call = call.strip()
        if call.startswith("prctl(PR_SET_SECCOMP") and call.endswith("= 0"):
            confined.add(process)
        elif process in confined and not re.search(r"= -1 |\+\+\+|---|resumed|CLONE_THREAD|PR_SET_NAME", call):
            assert call.startswith("open"), call
            opened.append(call.partition('"')[2].partition('"')[0])
    assert len(confined) == len(files)
    code = (
        sys.prefix,
        sys.base_prefix,
        str(checkout),
        "/proc/",
        "/sys/",
        "/dev/",
        "/lib",
        "/usr/lib",
        "/etc/ld.so.cache",
    )
    foreign = [
        path for path in opened if path.startswith("/") and not path.startswith((*code, str(tmp_path / "seeds")))
    ]
    assert foreign == []
    assert {str(file) for file in files if file.suffix == ".e57"} <= set(opened)


# The filter, on both kinds of processors


def judged(machine: str, number: int, arguments: tuple[int, ...] = (), *, architecture: int | None = None) -> int:
    """What the filter returns for a call, by the semantics of classic BPF."""
    known = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}
    data = {0: number, 4: known[machine] if architecture is None else architecture}
    data |= {16 + 8 * k: value for k, value in enumerate(arguments)}
    steps, at, word = filter_of(machine, process=1234), 0, 0
    while True:
        code, if_true, if_false, operand = steps[at]
        at += 1
        if code == 0x20:
            word = data[operand]
        elif code == 0x06:
            return operand
        else:
            is_true = {0x15: word == operand, 0x35: word >= operand, 0x45: bool(word & operand)}[code]
            at += if_true if is_true else if_false


@pytest.mark.parametrize("machine", ["x86_64", "aarch64"])
def test_the_filter_refuses_what_is_listed_and_nothing_else(machine: str) -> None:
    allow, refused, unknown = 0x7FFF0000, 0x50000 | errno.EPERM, 0x50000 | errno.ENOSYS
    which = ["x86_64", "aarch64"].index(machine)
    listed = {numbers[which] for numbers in _NUMBERS.values()} - {None}
    special = {"x86_64": (56, 62, 234, 157, 2, 257), "aarch64": (220, 129, 131, 167, 56)}[machine]
    for number in range(500):
        if number in listed:
            assert judged(machine, number) == refused, number
        elif number in (435, 437):
            assert judged(machine, number) == unknown
        elif number not in special:
            assert judged(machine, number) == allow, number
    clone, kill, tgkill, prctl, *_ = special
    assert (judged(machine, prctl, (1,)), judged(machine, prctl, (15,))) == (refused, allow)
    assert judged(machine, clone, (0x3D0F00,)) == allow  # a thread
    assert judged(machine, clone, (0x11,)) == refused  # a process
    for call in (kill, tgkill):
        assert judged(machine, call, (1234,)) == allow
        assert judged(machine, call, (1,)) == refused
    openat = special[-1]
    assert judged(machine, openat, (0, 0, os.O_RDONLY | 0o2000000)) == allow
    for flags in (os.O_WRONLY, os.O_RDWR, os.O_CREAT, os.O_TRUNC):
        assert judged(machine, openat, (0, 0, flags)) == refused
    assert judged(machine, 0, architecture=0x40000003) == 0x80000000  # 32-bit calls end the process
    if machine == "x86_64":
        assert judged(machine, 0x40000000) == unknown
    assert all(0 <= jump <= 255 for step in filter_of(machine, 1) for jump in step[1:3])


def test_every_means_is_stated() -> None:
    assert [name for name, _ in confinement()] == ["Landlock", "seccomp"]
    if sys.platform == "linux" and platform.machine() in ("x86_64", "aarch64"):
        assert MEANS["seccomp"] == "yes"
