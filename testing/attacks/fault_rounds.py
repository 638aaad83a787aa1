"""Rounds of work in a process whose n-th system call of a kind fails, whose memory is limited, or that loses power."""

from __future__ import annotations

import ctypes
import errno
import hashlib
import multiprocessing
import os
import random
import shutil
import socket
import tempfile
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

from testing.attacks.fault_cases import CASES, Case
from testing.attacks.power_loss import PowerLoss, State, put
from testing.attacks.system_calls import Call, hand_over_calls, watch_calls

ERRORS = {
    "write": errno.ENOSPC, "fsync": errno.EIO, "rename": errno.EIO, "truncate": errno.EIO, "open": errno.EIO,
    "readdir": errno.EIO, "stat": errno.EIO, "mkdir": errno.ENOSPC, "unlink": errno.EIO,
}  # fmt: skip
"""The errors of calls that fail, by their kinds."""
_PROCESSES = multiprocessing.get_context("forkserver")
_LONGEST_S = 120.0
_BALLAST_BYTES = (1 << 20, 1 << 16, 1 << 12)
_prepared: dict[str, tempfile.TemporaryDirectory[str]] = {}
_LONGEST_SENTENCE, _SHORTEST_SENTENCE = 700, 20  # characters


@dataclass
class Round:
    """What came of one round."""

    case: str
    what: str
    """What failed."""
    said: str = ""
    """The sentence that the work ended with; empty: it succeeded."""
    wrong: list[str] = field(default_factory=list)
    """What is wrong."""
    calls: Counter[str] = field(default_factory=Counter)
    """Calls that were about the folder, by kind."""
    crashed: bool = False
    """Whether the process was ended by a signal: in a few places NumPy does not check that memory was allocated."""


class _Stack(ctypes.Structure):
    """An argument that is passed on the stack."""

    _fields_ = (("room", ctypes.c_char * (2 << 20)),)


def ready() -> None:
    """Load what all rounds need once, before the first of them; they are forked from there."""
    os.environ["OPENBLAS_NUM_THREADS"] = "1"  # a process with threads cannot be forked
    _PROCESSES.set_forkserver_preload(["testing.attacks.fault_preload"])


def counted(case: str) -> Round:
    """Do the work with nothing failing; the calls are counted."""
    return faulted(case, "", 0)


def faulted(case: str, kind: str, number: int) -> Round:
    """Let the n-th call of a kind fail, from 0.

    Args:
        case: name of the case.
        kind: kind of the call; empty: nothing fails.
        number: of the call that fails.
    """
    found = Round(case, f"{kind} {number}" if kind else "nothing")
    with _rooms(CASES[case]) as (room, beside):

        def judge(call: Call) -> int:
            if not _is_about(call, room):
                return 0
            place = found.calls[call.kind]
            found.calls[call.kind] += 1
            return ERRORS[kind] if (call.kind, place) == (kind, number) else 0

        child = _Child(CASES[case], room, beside)
        watch_calls(child.connection, judge)
        _judge(found, child, room)
    return found


def limited(case: str, extra_bytes: int) -> Round:
    """Limit the address space to what the process has before the work and this many bytes more, at least 1."""
    found = Round(case, f"memory {extra_bytes >> 10} kB")
    with _rooms(CASES[case]) as (room, beside):
        child = _Child(CASES[case], room, beside, extra_bytes=extra_bytes)
        watch_calls(child.connection, lambda call: 0)
        _judge(found, child, room, may_crash=True)
    return found


def powerless(case: str, *, most: int | None = None, seed: int = 0) -> Iterator[Round]:
    """Cut the power before every call, and after the work; yield a round for each different state that may be left.

    Args:
        case: name of the case.
        most: number of states to draw, besides those after the work; None: all.
        seed: of the draw.
    """
    seen: set[bytes] = set()
    states: list[tuple[str, int, bool, State]] = []
    with _rooms(CASES[case]) as (room, beside):
        disk = PowerLoss(room)
        counts: Counter[str] = Counter()
        child = _Child(CASES[case], room, beside)

        def note(when: str, *, done: bool) -> None:
            for how, state in disk.states():
                confirmed = child.confirmed()
                key = hashlib.sha256(repr((confirmed, done, sorted(state.items()))).encode()).digest()
                if key not in seen:
                    seen.add(key)
                    states.append((f"power lost {when}, {how}", confirmed, done, state))

        def judge(call: Call) -> int:
            if _is_about(call, room):
                if call.kind not in ("stat", "readdir"):  # which change nothing
                    note(f"before {call.kind} {counts[call.kind]}", done=False)
                counts[call.kind] += 1
                disk.see(call)
            return 0

        watch_calls(child.connection, judge)
        said = child.ended()
        if said:
            yield Round(case, "nothing", said, [f"it failed: {said}"])
            return
        note("after the end", done=True)
    during, after = ([state for state in states if state[2] is done] for done in (False, True))
    drawn = during if most is None else random.Random(seed).sample(during, min(most, len(during)))
    for what, confirmed, done, state in (*drawn, *after):
        with tempfile.TemporaryDirectory(prefix="power-") as name:
            put(state, Path(name) / "room")
            found = Round(case, what)
            _compare(found, Path(name) / "room", confirmed, done=done)
            yield found


@contextmanager
def _rooms(case: Case) -> Iterator[tuple[Path, Path]]:
    if case.name not in _prepared:
        before = tempfile.TemporaryDirectory(prefix="faults-before-")  # until this process ends
        case.prepare(Path(before.name, "room"), Path(before.name, "beside"))
        _prepared[case.name] = before
    with tempfile.TemporaryDirectory(prefix="faults-") as name:
        place = Path(os.path.realpath(name), "place")
        shutil.copytree(_prepared[case.name].name, place)
        yield place / "room", place / "beside"


def _is_about(call: Call, room: Path) -> bool:
    """Return whether a call concerns what lies in the folder; the folder's own name is not part of the work."""
    path = os.path.normpath(call.path)
    return path.startswith(f"{room}{os.sep}") or (path == str(room) and call.kind in ("fsync", "readdir"))


class _Child:
    """A process that does the work of a case, whose calls are handed over."""

    def __init__(self, case: Case, room: Path, beside: Path, *, extra_bytes: int = 0) -> None:
        self.connection, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._process = _PROCESSES.Process(target=_work, args=(theirs, case.name, room, beside, extra_bytes))
        self._process.start()
        theirs.close()
        self.last, self._said = 0, ""
        self._ended = threading.Event()

    def confirmed(self) -> int:
        """Return the number of the last thing that the work has confirmed so far."""
        self._hear(socket.MSG_DONTWAIT)
        return self.last

    @property
    def crashed(self) -> bool:
        """Whether it was ended by a signal."""
        return (self._process.exitcode or 0) < 0

    def ended(self) -> str:
        """Return the sentence that the work ended with; empty: it succeeded."""
        self.connection.settimeout(_LONGEST_S)
        self._hear(0)
        self._process.join(_LONGEST_S)
        self.connection.close()
        return self._said if self._ended.is_set() else f"it ended without a word, with {self._process.exitcode}"

    def _hear(self, flags: int) -> None:
        while not self._ended.is_set():
            try:
                said = self.connection.recv(1 << 16, flags)
            except (BlockingIOError, ConnectionError):
                return
            if not said:
                return
            if said.startswith(b"saved "):
                self.last = int(said[6:])
            else:
                self._said = said[6:].decode(errors="replace")
                self._ended.set()


def _work(connection: socket.socket, case: str, room: Path, beside: Path, extra_bytes: int) -> None:
    import faulthandler
    import resource

    from ladarreg.cli import _explain

    sentence = ""
    faulthandler.dump_traceback_later(_LONGEST_S, exit=True)
    hand_over_calls(connection)
    ballast: list[bytearray] = []

    def limit() -> None:
        if not extra_bytes or ballast:
            return
        # The kernel kills a process whose stack cannot grow: let it grow first.
        ctypes.CDLL(None).getpid(_Stack())
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
        size = pages * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (size, resource.RLIM_INFINITY))
        for piece in _BALLAST_BYTES:  # memory that the process holds unused must not serve the work
            with suppress(MemoryError):
                while True:
                    ballast.append(bytearray(piece))
        resource.setrlimit(resource.RLIMIT_AS, (size + extra_bytes, resource.RLIM_INFINITY))

    def tell(done: int) -> None:
        _send(connection, f"saved {done}")
        limit()

    if not CASES[case].starts_threads:
        limit()
    try:
        CASES[case].work(room, beside, tell)
    except BaseException as error:
        try:
            sentence, _ = _explain(error)
        except BaseException as second:
            sentence = f"internal error {type(second).__name__}"
    _send(connection, f"ended {sentence}")
    os._exit(0)


def _send(connection: socket.socket, text: str) -> None:
    connection.send(text.encode(errors="replace")[: 1 << 15])


def _judge(found: Round, child: _Child, room: Path, *, may_crash: bool = False) -> None:
    found.said = child.ended()
    found.crashed = child.crashed
    _compare(found, room, child.last, done=not found.said)
    if found.said and not _is_sentence(found.said) and not (found.crashed and may_crash):
        found.wrong.append(f"no clear sentence: {found.said!r}")


def _compare(found: Round, room: Path, confirmed: int, *, done: bool) -> None:
    try:
        if wrong := CASES[found.case].fault(room, confirmed, done):
            found.wrong.append(wrong)
    except Exception as error:
        found.wrong.append(f"it cannot be inspected: {type(error).__name__}: {error}")


def _is_sentence(text: str) -> bool:
    return (
        text.isprintable()
        and _SHORTEST_SENTENCE < len(text) <= _LONGEST_SENTENCE
        and "internal error" not in text
        and "Traceback" not in text
        and not text.startswith("it ended without")
    )
