"""System calls of a child process, each shown to this one, which may refuse it, before the kernel carries it out.

Linux hands them over (`SECCOMP_RET_USER_NOTIF`): no privilege and no tool is needed, and what C libraries do is seen
like what Python does.

Source: Documentation/userspace-api/seccomp_filter.rst of the Linux kernel, 'Userspace Notification'.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
import platform
import select
import socket
import struct
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

_ARCHITECTURES = ("x86_64", "aarch64")
_CALLS: dict[str, dict[tuple[int | None, int | None], tuple[int, int | None]]] = {
    # numbers of a call on x86_64 and aarch64 (None: it has none), then which argument is its open file or folder
    # (-1: the working folder), and which is its path, if it has one
    "write": {
        (1, 64): (0, None), (20, 66): (0, None), (18, 68): (0, None), (296, 70): (0, None), (328, 287): (0, None),
        (40, 71): (0, None), (326, 285): (2, None),
    },
    "fsync": {(74, 82): (0, None), (75, 83): (0, None)},
    "rename": {(82, None): (-1, 0), (264, 38): (0, 1), (316, 276): (0, 1), (86, None): (-1, 0), (265, 37): (0, 1)},
    "truncate": {(77, 46): (0, None), (76, 45): (-1, 0)},
    "open": {(2, None): (-1, 0), (257, 56): (0, 1), (85, None): (-1, 0)},
    "readdir": {(217, 61): (0, None)},
    "stat": {(4, None): (-1, 0), (6, None): (-1, 0), (262, 79): (0, 1), (332, 291): (0, 1)},
    "mkdir": {(83, None): (-1, 0), (258, 34): (0, 1)},
    "unlink": {(87, None): (-1, 0), (84, None): (-1, 0), (263, 35): (0, 1)},
}  # fmt: skip
KINDS = tuple(_CALLS)
"""Kinds of calls."""
_SECCOMP = (317, 277)
_SET_FILTER, _NEW_LISTENER, _NO_NEW_PRIVS = 1, 1 << 3, 38
_NOTIFY, _ALLOW = 0x7FC00000, 0x7FFF0000
_LOAD, _JUMP_EQUAL, _RETURN = 0x20, 0x15, 0x06
_RECEIVE, _ANSWER = 0xC0502100, 0xC0182101
_CONTINUE = 1
_WORKING_FOLDER = -100
_LONGEST_PATH = 4096


@dataclass(frozen=True, slots=True)
class Call:
    """A system call that a process is about to make."""

    kind: str
    """One of `KINDS`."""
    process: int
    descriptor: int | None
    """The open file that it is about; None: it has a path."""
    path: Path
    """The path that it is about, of a rename the old one; not normalised."""


Judge = Callable[[Call], int]
"""Receives each call; returns the number of the error that it fails with, or 0."""


def can_watch() -> bool:
    """Return whether this system hands over system calls."""
    if sys.platform != "linux" or platform.machine() not in _ARCHITECTURES:
        return False
    try:
        actions = Path("/proc/sys/kernel/seccomp/actions_avail").read_text(encoding="ascii")
    except OSError:
        return False
    return "user_notif" in actions


def hand_over_calls(connection: socket.socket) -> None:
    """Send the calls of this process, which is single-threaded, to the one at the other end, for the rest of its life.

    Raises:
        OSError: if the system refuses.
    """
    which = _ARCHITECTURES.index(platform.machine())
    numbers = [pair[which] for calls in _CALLS.values() for pair in calls if pair[which] is not None]
    steps = [(_LOAD, 0, 0, 0)]
    steps += [(_JUMP_EQUAL, len(numbers) - place, 0, number or 0) for place, number in enumerate(numbers)]
    code = b"".join(struct.pack("=HBBI", *step) for step in (*steps, (_RETURN, 0, 0, _ALLOW), (_RETURN, 0, 0, _NOTIFY)))

    class Program(ctypes.Structure):
        _fields_ = (("length", ctypes.c_ushort), ("instructions", ctypes.c_char_p))

    library = ctypes.CDLL(None, use_errno=True)
    library.prctl(_NO_NEW_PRIVS, 1, 0, 0, 0)
    program = Program(len(code) // 8, code)
    listener = library.syscall(_SECCOMP[which], _SET_FILTER, _NEW_LISTENER, ctypes.byref(program))
    if listener < 0:
        raise OSError(ctypes.get_errno(), "system calls cannot be handed over")
    socket.send_fds(connection, [b"calls"], [listener])
    os.close(listener)
    connection.recv(1)  # until the other end listens


def watch_calls(connection: socket.socket, judge: Judge) -> None:
    """Show the calls of the process at the other end to a judge, until it ends."""
    _, (listener,), _, _ = socket.recv_fds(connection, 16, 1)
    try:
        connection.sendall(b"!")
        for identity, call in _calls(listener):
            error = judge(call)
            answer = struct.pack("=Qqii", identity, 0, -error, 0 if error else _CONTINUE)
            with suppress(FileNotFoundError):  # it was killed meanwhile
                fcntl.ioctl(listener, _ANSWER, bytearray(answer))
    finally:
        os.close(listener)


def _calls(listener: int) -> Iterator[tuple[int, Call]]:
    which = _ARCHITECTURES.index(platform.machine())
    known = {pair[which]: (kind, *where) for kind, calls in _CALLS.items() for pair, where in calls.items()}
    poll = select.poll()
    poll.register(listener, select.POLLIN)
    while True:
        ((_, events),) = poll.poll()
        if not events & select.POLLIN:
            return
        received = bytearray(80)
        try:
            fcntl.ioctl(listener, _RECEIVE, received)
        except OSError as error:
            if error.errno in (errno.ENOENT, errno.EINTR):
                continue
            raise
        identity, process, _, number, _, _, *arguments = struct.unpack("=QIIiIQ6Q", received)
        kind, folder_at, path_at = known[number]
        descriptor = _WORKING_FOLDER if folder_at < 0 else ctypes.c_int(arguments[folder_at]).value
        text = b"" if path_at is None else _text(process, arguments[path_at])
        yield identity, Call(kind, process, None if text else descriptor, _path(process, descriptor, text))


def _text(process: int, address: int) -> bytes:
    found = b""
    with suppress(OSError), open(f"/proc/{process}/mem", "rb", buffering=0) as memory:
        while b"\0" not in found and len(found) < _LONGEST_PATH:
            memory.seek(address + len(found))
            found += memory.read(256 - (address + len(found)) % 256)  # within a page
    return found.partition(b"\0")[0]


def _path(process: int, descriptor: int, text: bytes) -> Path:
    if text.startswith(b"/"):
        return Path(os.fsdecode(text))
    opened = "cwd" if descriptor == _WORKING_FOLDER else f"fd/{descriptor}"
    try:
        folder = os.readlink(f"/proc/{process}/{opened}")
    except OSError:
        return Path(os.fsdecode(text))
    return Path(folder.removesuffix(" (deleted)"), os.fsdecode(text))
