"""Reader processes are confined: what takes one over opens nothing else, connects nowhere and starts nothing."""

from __future__ import annotations

import errno
import os
import platform
import shutil
import socket
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
from ladarreg_core.formats.isolated.worker import _readable
from testing.attacks.hostile_files import Listener, traced_reading, write_hostile
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
    (tmp_path / "neighbour").write_bytes(b"foreign")
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


@pytest.mark.slow
def test_nobody_hears_of_fifty_hostile_files(readers: IsolatedReaders, tmp_path: Path, listener: Listener) -> None:
    for file in write_hostile(tmp_path, 50, listener.address):
        for describing in (lambda path: readers.run(describe, path), describe):  # the second is not confined
            with suppress(LadarregError):
                describing(file)
    assert listener.heard == 0
    with suppress(OSError):  # the listener listens
        socket.create_connection(("127.0.0.1", listener.port)).close()
    for _ in range(100):
        if listener.heard:
            return
        threading.Event().wait(0.02)
    pytest.fail("the listener is deaf")


@CONFINED
@pytest.mark.slow
@pytest.mark.skipif(shutil.which("strace") is None, reason="strace is not installed")
def test_system_calls_show_no_connection_and_no_foreign_file(tmp_path: Path, listener: Listener) -> None:
    """A drawn share of `benchmarks.abuse.hostile`, and files that are not hostile."""
    (tmp_path / "in").mkdir()
    files = write_hostile(tmp_path / "in", 12, listener.address)
    sound = list((tmp_path / "in" / "seeds").rglob("*.e57"))[:3]
    found = traced_reading([*files, *sound], tmp_path / "in", tmp_path / "log")
    if found is None:
        pytest.skip("tracing is not permitted here")
    assert (found.foreign, found.others, found.confined) == ((), (), len(files) + len(sound))
    assert {str(file) for file in sound} <= {*found.opened}
    assert listener.heard == 0


def test_a_companion_that_is_a_link_is_not_readable(tmp_path: Path) -> None:
    (tmp_path / "secret").write_bytes(b"foreign")
    (tmp_path / "images.bin").write_bytes(b"")
    (tmp_path / "images.txt").symlink_to(tmp_path / "secret")
    request = {"args": [tmp_path / "cameras.txt"], "kwargs": {}, "folder": str(tmp_path)}
    assert [path.name for path in _readable(request)] == ["cameras.txt", "images.bin"]


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
