"""What a power failure leaves of a folder: only what was synchronised is certain."""

from __future__ import annotations

import os
import stat
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

from testing.attacks.system_calls import Call

T = TypeVar("T")
_MAX_LOOKS = 50
State = dict[str, bytes | None]
"""Contents of files by their names relative to the folder; None: it is a folder."""


class PowerLoss:
    """Follows a folder through the calls of a process; must see each call before it is carried out.

    A file's contents are certain as they were when it was last synchronised, a folder's entries likewise. Anything else
    may be on the disk or not; `states` has the extremes: nothing of it, all names without their contents (file systems
    write names early), and all of it, as after a kill.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._numbers: dict[int, int] = {}  # of inodes, each file's own even if the system uses an inode again
        self._next = 0
        self._contents: dict[int, bytes] = {}
        self._entries: dict[int, dict[str, int]] = {}
        self._look()
        for path, number in self._walk():
            if path.is_dir():
                self._entries[number] = self._listing(path)
            else:
                self._contents[number] = path.read_bytes()

    def see(self, call: Call) -> None:
        """Take note of a call that will be carried out."""
        _again(lambda: self._see(call))

    def _see(self, call: Call) -> None:
        self._look()
        if call.kind != "fsync" or call.descriptor is None:
            return
        opened = f"/proc/{call.process}/fd/{call.descriptor}"
        status = os.stat(opened)
        number = self._numbers.get(status.st_ino)
        if number is None:
            return
        if stat.S_ISDIR(status.st_mode):
            self._entries[number] = self._listing(Path(os.readlink(opened)))
        else:
            with open(opened, "rb") as file:
                self._contents[number] = file.read()

    def states(self) -> list[tuple[str, State]]:
        """Return what a failure at this moment may leave, each with what it is called."""
        return _again(lambda: list(self._states()))

    def _states(self) -> Iterator[tuple[str, State]]:
        self._look()
        root = self._numbers[os.stat(self._folder).st_ino]
        synced: State = {}
        self._collect(root, "", synced)
        yield "only what was synchronised", synced
        _, *inside = self._walk()
        here = [(path.relative_to(self._folder).as_posix(), path, number) for path, number in inside]
        yield (
            "names without contents",
            {name: None if path.is_dir() else self._contents.get(number, b"") for name, path, number in here},
        )
        yield "as after a kill", {name: None if path.is_dir() else path.read_bytes() for name, path, _ in here}

    def _collect(self, folder: int, above: str, found: State) -> None:
        for name, number in self._entries.get(folder, {}).items():
            if number in self._entries or number in self._folders:
                found[above + name] = None
                self._collect(number, f"{above}{name}/", found)
            else:
                found[above + name] = self._contents.get(number, b"")

    def _look(self) -> None:
        """Give numbers to new files, and forget the inodes of removed ones."""
        there: dict[int, bool] = {}
        for path in self._paths():
            with suppress(FileNotFoundError):
                status = os.lstat(path)
                there[status.st_ino] = stat.S_ISDIR(status.st_mode)
        self._numbers = {inode: number for inode, number in self._numbers.items() if inode in there}
        for inode in there:
            if inode not in self._numbers:
                self._numbers[inode], self._next = self._next, self._next + 1
        self._folders = {self._numbers[inode] for inode, is_folder in there.items() if is_folder}

    def _paths(self) -> Iterator[Path]:
        yield self._folder
        for parent, folders, files in os.walk(self._folder):
            yield from (Path(parent, name) for name in (*folders, *files))

    def _walk(self) -> Iterator[tuple[Path, int]]:
        for path in self._paths():
            if not path.is_symlink() and not path.is_fifo():
                yield path, self._numbers[os.lstat(path).st_ino]

    def _listing(self, folder: Path) -> dict[str, int]:
        return {name: self._numbers[os.lstat(folder / name).st_ino] for name in os.listdir(folder)}


def _again(look: Callable[[], T]) -> T:
    """Look at the folder again if another thread of the process has removed a file meanwhile."""
    for _ in range(_MAX_LOOKS):
        with suppress(FileNotFoundError, KeyError):
            return look()
    return look()


def put(state: State, folder: Path) -> None:
    """Write a state into a new folder."""
    folder.mkdir(parents=True)
    for name in sorted(state):
        contents = state[name]
        if contents is None:
            (folder / name).mkdir(parents=True, exist_ok=True)
        else:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(contents)
