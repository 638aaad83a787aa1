"""Disks that become full in the middle of a record: edits reported as saved must be on them."""

from __future__ import annotations

import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from testing.attacks.kill_rounds import with_photo
from testing.attacks.server_process import Editor, Server, ServerGone, matches_of, start_server

_DISK_MB = 8
_RETRIED_S = 60.0
"""Time within which a server that waits for free space tries again."""


class Disk(Protocol):
    """A disk that can be filled."""

    folder: Path

    def fill(self, server: Server, left: int) -> None:
        """Leave a number of free bytes."""

    def is_at_end(self) -> bool:
        """Return whether the last record was truncated: whether the history ends where the disk was full."""

    def make_room(self, server: Server) -> None:
        """Free the disk again."""


class MountedDisk:
    """A small separate disk, filled by a file next to the project."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._ballast = folder / "ballast"

    def fill(self, server: Server, left: int) -> None:
        """Leave a number of free bytes, in whole pages."""
        with self._ballast.open("wb", buffering=0) as file:
            block = b"\0" * 4096
            try:
                while file.write(block) == len(block):
                    pass
            except OSError:
                pass
            size = file.tell()
            file.truncate(max(0, size - left))

    def is_at_end(self) -> bool:
        """Return whether the history ends at a page boundary."""
        return (self.folder / "project" / "history.jsonl").stat().st_size % 4096 == 0

    def make_room(self, server: Server) -> None:
        """Remove the ballast."""
        self._ballast.unlink(missing_ok=True)


class LimitedDisk:
    """A limit of file sizes instead of a disk, which truncates a record at any byte: Linux, without root."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._most = -1

    def fill(self, server: Server, left: int) -> None:
        """Limit the size of the server's files to that of its history plus a number of bytes."""
        self._most = (self.folder / "project" / "history.jsonl").stat().st_size + left
        self._limit(server, self._most)

    def is_at_end(self) -> bool:
        """Return whether the history has reached the limit."""
        return (self.folder / "project" / "history.jsonl").stat().st_size == self._most

    def make_room(self, server: Server) -> None:
        """Remove the limit."""
        self._limit(server, -1)

    def _limit(self, server: Server, most: int) -> None:
        import resource

        resource.prlimit(server.process.pid, resource.RLIMIT_FSIZE, (most, resource.RLIM_INFINITY))


@dataclass
class DiskRound:
    """Outcome of one full disk."""

    disk: str
    saved: int
    """Edits reported as saved."""
    unsaved: int
    """Edits reported as not saved while the disk was full."""
    lost: list[str] = field(default_factory=list)


@contextmanager
def mounted_disk() -> Iterator[MountedDisk | None]:
    """Mount a small disk in memory; None where that is not permitted or not supported."""
    if sys.platform != "linux":
        yield None
        return
    with tempfile.TemporaryDirectory(prefix="small-disk-") as name:
        words = ["mount", "-t", "tmpfs", "-o", f"size={_DISK_MB}m", "tmpfs", name]
        try:
            done = subprocess.run(words, capture_output=True, check=False)
        except OSError:
            yield None
            return
        if done.returncode:
            yield None
            return
        try:
            yield MountedDisk(Path(name))
        finally:
            subprocess.run(["umount", "-l", name], capture_output=True, check=False)


def full_disk(room: Path, disk: Disk, *, seed: int, ends: str) -> DiskRound:
    """Edit, fill the disk in the middle of a record, continue to edit, and stop.

    Args:
        room: an empty folder with room.
        disk: an empty one.
        seed: of edits and moments.
        ends: `torn`: room is made as soon as a record was torn, five more edits, killed; `kill`: the same after some
            edits that were answered as not saved; `wait`: killed a while after that, when
            even what was not answered as saved must be there; `stop`: by a signal while it is full, which the server
            must admit.
    """
    rng = random.Random(seed)
    project = disk.folder / "project"
    server = with_photo(room, project, scan=True)  # its files are outside the project: nothing large is uploaded
    found = DiskRound(type(disk).__name__, 0, 0)
    try:
        page = server.page()
        photo = page.slices["shown"]
        editor = Editor(photo, rng)
        for _ in range(rng.randrange(3, 20)):
            editor.edit(page)
        # A record has about 200 bytes: the free space is enough for none, one and a half, or a few of them.
        disk.fill(server, rng.choice((rng.randrange(1, 150), rng.randrange(1, 1500))))
        for _ in range(60):
            editor.edit(page)
            if editor.unsaved > 4 or (ends == "torn" and (editor.unsaved or disk.is_at_end())):
                break
        if not editor.unsaved:
            found.lost.append(f"{editor.answered} edits were answered as saved, the last ones by a full disk")
        if ends == "stop":
            found.lost += _stopped_while_full(server, editor)
        else:
            disk.make_room(server)
            for _ in range(5):
                editor.edit(page)
            if ends == "wait":
                found.lost += _saved_by_itself(server, editor)
            server.kill()
        page.close()
    except (ServerGone, TimeoutError) as error:
        found.lost.append(f"the server is gone: {error}")
    finally:
        if server.process.poll() is None:
            server.kill()
    found.saved, found.unsaved = editor.answered, editor.unsaved
    disk.make_room(server) if isinstance(disk, MountedDisk) else None
    try:
        with start_server(room, project) as again:
            page = again.page()
            found.lost += editor.lost(matches_of(page, photo) if f"picks:{photo}" in page.slices else {})
            page.close()
    except ServerGone as error:
        found.lost.append(f"the project cannot be opened: {error}")
    return found


def _saved_by_itself(server: Server, editor: Editor) -> list[str]:
    """Wait until the page reports that everything is saved; then all edits must be on disk."""
    page, until = server.page(), time.monotonic() + _RETRIED_S
    try:
        while page.slices["project"]["unsaved"] and time.monotonic() < until:
            try:
                page.take(page.hear(max(0.1, until - time.monotonic())))
            except TimeoutError:
                break
        if page.slices["project"]["unsaved"]:
            return [f"nothing was saved within {_RETRIED_S:g} s of there being room"]
    finally:
        page.close()
    editor.saved |= {name: spots[-1] for name, spots in editor.open.items()}
    editor.open.clear()
    return []


def _stopped_while_full(server: Server, editor: Editor) -> list[str]:
    """Stop the server; it must report unsaved edits, or that it has saved them in another folder."""
    try:
        code = server.stop()
    except subprocess.TimeoutExpired:
        return ["it did not end within a minute"]
    said = server.stderr().lower()
    losses = []
    if code != 1:
        losses.append(f"{editor.unsaved} edits were not saved, and the exit code is {code}; it must be 1")
    if "save" not in said:
        losses.append(f"{editor.unsaved} edits were not saved, and it does not say so: {said.strip()[-200:]!r}")
    return losses
