"""A scanner or camera with software of its own: a folder in which new files appear for each stop."""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
import stat
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from ladarreg_core.acquisition.clock import REAL_CLOCK, Clock
from ladarreg_core.acquisition.interfaces import Arrival, Check
from ladarreg_core.acquisition.trigger import Trigger, TriggerPlan, opened_trigger
from ladarreg_core.errors import DeviceError
from ladarreg_core.formats.scans.scan_files import ScanFiles

_NAP_S = 0.05
_STABLE_S = 0.7
_TEMPORARY = (".tmp", ".part", ".partial", ".crdownload", ".swp", ".lock", "~")
_MAX_NAMED = 5
_BLOCK = 1 << 20


@dataclass(frozen=True, slots=True)
class _State:
    """A file as the system describes it."""

    inode: int
    """0 where the system has none."""
    size: int
    time_ns: int
    """Compared with itself only: the clock of another computer may have written it."""


class FolderSource:
    """Waits for the next complete measurement in a folder.

    What the folder has when the unit arrives was measured somewhere else, and belongs to no stop: also while it still
    grows, and when it is given another name later. A measurement is complete when its files have not changed for a
    while and can be read. A file that was taken for an earlier stop and is written anew under its old name counts as
    new, unless it only gets longer.

    Symbolic links in the folder are not followed: those who may write there must not get at files that only the
    operator may read.

    Args:
        folder: the watched folder.
        is_readable: raises a `LadarregError` for a file that cannot be read as what is expected.
        timeout_s: longest wait for a measurement.
        device: what writes there, for messages.
        files_of: returns what belongs together with a file.
        trigger: what starts a measurement; None: something else does.
        clock: what the waiting is measured by.

    Raises:
        DeviceError: if the folder is gone, or the port of the trigger cannot be opened.
    """

    def __init__(
        self,
        folder: str | Path,
        *,
        is_readable: Callable[[Path], None],
        timeout_s: float,
        device: str,
        files_of: Callable[[Path], ScanFiles] = lambda path: ScanFiles(path, (path,)),
        trigger: TriggerPlan | None = None,
        clock: Clock = REAL_CLOCK,
    ) -> None:
        self._folder, self._is_readable, self._files_of = Path(folder).expanduser(), is_readable, files_of
        self._timeout_s, self._device, self._clock = timeout_s, device, clock
        self._ignored = trigger.file if trigger is not None else ""
        self._trigger: Trigger | None = None
        if trigger is not None:
            self._trigger = opened_trigger(trigger, self._folder, timeout_s=timeout_s, device=device, clock=clock)
        self._stop: Arrival | None = None
        self._listed: dict[str, _State] = {}
        self._links: set[str] = set()
        self._known = self._files()
        """Files that need no more looking at: there from the beginning, taken, or kept aside."""
        self._before = _Before(self._known)
        self._taken: dict[str, tuple[_State, str]] = {}
        self._strays: list[str] = []

    def arrived(self, stop: Arrival) -> None:
        """Take note that the unit stands at a stop: only what is written from now on is measured there.

        Raises:
            DeviceError: if the folder is gone.
        """
        self._stop = stop
        there = self._files()
        self._strays += [
            name
            for name, state in there.items()
            if _is_finished(name) and self._known.get(name) != state and name not in self._strays
        ]
        self._known |= {name: state for name, state in there.items() if _is_finished(name)}
        self._before = _Before(there)

    def next_file(self, folder: Path, *, check: Check) -> Path:
        """Await the measurement of the stop and copy its files, under their names, into `folder`; return what to read.

        Raises:
            DeviceError: if none comes in time, the folder is gone, or a file cannot be read.
            Cancelled: if `check` raises it.
        """
        if self._trigger is not None:
            assert self._stop is not None, "the unit has arrived somewhere before a measurement is asked for"
            self.arrived(self._stop)  # what was written while the unit settled was not triggered either
            self._trigger.fire(self._stop, check=check)
        begun = self._clock.now()
        watch = _Watch()
        unreadable: dict[str, str] = {}
        while True:
            check()
            now = self._clock.now()
            there = self._files()
            self._before.forget_removed(there)
            watch.see(there, now)
            new = [name for name, state in there.items() if _is_finished(name) and self._is_new(name, state)]
            for name in new:
                files = self._files_of(self._folder / name)
                if not self._are_complete(files, watch, now):
                    continue
                try:
                    self._is_readable(files.opened)
                except Exception as error:  # it may still be growing, by a writer that pauses
                    unreadable[name] = str(error)
                    watch.again(name, now)
                    continue
                if (copy := self._copied(files, folder)) is not None:
                    self._take(files)
                    return copy
            if unreadable and now - begun > self._timeout_s / 2 and unreadable.keys() >= {*new}:
                self._known |= {name: there[name] for name in new}
                name, why = next(iter(unreadable.items()))
                raise DeviceError(f"{self._device} wrote {name}, which cannot be read ({why}); measure again")
            if now - begun > self._timeout_s:
                raise DeviceError(self._late(new, unreadable))
            self._clock.sleep(_NAP_S)

    def keep_strays(self, folder: Path) -> list[Path]:
        """Copy what was written, and belongs to no stop, into `folder`; return the copies. Each is given once.

        A file that is gone by then is passed over.
        """
        strays, self._strays = self._strays, []
        kept = []
        for name in strays:
            folder.mkdir(parents=True, exist_ok=True)
            try:
                _copy(self._folder, name, folder / name)
            except FileNotFoundError:
                continue
            kept.append(folder / name)
        return kept

    def close(self) -> None:
        """Release the trigger; the folder stays."""
        if self._trigger is not None:
            self._trigger.close()

    def _is_new(self, name: str, state: _State) -> bool:
        """Return whether a file was written since the unit arrived."""
        before = self._before.of(name, state)
        if before is None:
            return self._known.get(name) != state
        return before != state and self._taken_as(before) is not None

    def _only_grew(self, name: str, state: _State) -> bool:
        """Return whether a file is one that was taken before, with something appended since."""
        before = self._before.of(name, state)
        digest = None if before is None else self._taken_as(before)
        if before is None or digest is None or state.size < before.size:
            return False
        return self._digest(name, before.size) == digest

    def _digest(self, name: str, size: int) -> str:
        """Return the SHA-256 of the first bytes of a file; empty if it is gone."""
        digest = hashlib.sha256()
        try:
            with _opened(self._folder, name) as file:
                while size and (block := file.read(min(size, _BLOCK))):
                    digest.update(block)
                    size -= len(block)
        except FileNotFoundError:
            return ""
        return digest.hexdigest()

    def _taken_as(self, state: _State) -> str | None:
        """Return the SHA-256 of a file that was taken for an earlier stop as it was then; None if it was not."""
        return next((digest for taken, digest in self._taken.values() if taken == state), None)

    def _are_complete(self, files: ScanFiles, watch: _Watch, now: float) -> bool:
        """Return whether all files of a measurement are there, at rest, and measured since the unit arrived."""
        for path in files.all:
            name = path.relative_to(self._folder).as_posix()
            state = self._listed.get(name) or _state_of(path)
            if state is None or not watch.is_at_rest(name, state, now):
                return False
            if path in files.measured and (not self._is_new(name, state) or self._only_grew(name, state)):
                return False
        return True

    def _copied(self, files: ScanFiles, folder: Path) -> Path | None:
        """Return the copy of the file to be read; None if one was changed meanwhile."""
        before = [_state_of(path) for path in files.all]
        for path in files.all:
            copy = folder / path.relative_to(self._folder)
            copy.parent.mkdir(parents=True, exist_ok=True)
            try:
                _copy(self._folder, path.relative_to(self._folder).as_posix(), copy)
            except FileNotFoundError:
                return None
        if [_state_of(path) for path in files.all] != before:
            return None
        return folder / files.opened.relative_to(self._folder)

    def _take(self, files: ScanFiles) -> None:
        for path in files.all:
            name, state = path.relative_to(self._folder).as_posix(), _state_of(path)
            if state is not None:
                self._known[name] = state
                if path in files.measured:
                    self._taken[name] = state, self._digest(name, state.size)
        if self._trigger is not None:
            self._trigger.taken()

    def _late(self, new: list[str], unreadable: dict[str, str]) -> str:
        """Return what was found in place of a measurement."""
        came = [f"{name} came but cannot be read: {why}" for name, why in unreadable.items() if name in new]
        growing = [name for name in new if name not in unreadable]
        came += [f"{', '.join(growing[:_MAX_NAMED])} came but is not complete"] if growing else []
        linked = sorted(self._links)[:_MAX_NAMED]
        are = "is a symbolic link" if len(linked) == 1 else "are symbolic links"
        came += [f"{', '.join(linked)} {are}, not followed"] if linked else []
        old = [name for name, state in self._listed.items() if self._before.was_changed(name, state)]
        came += (
            [f"{', '.join(old[:_MAX_NAMED])} was there before the unit arrived, so it does not count"] if old else []
        )
        return (
            f"{self._device} has written no complete file into {self._folder} within {self._timeout_s:.0f} s"
            f"{' (' + '; '.join(came) + ')' if came else ''}; start its measurement, or check the folder, and resume"
        )

    def _files(self) -> dict[str, _State]:
        """Return the files of the folder that are not empty, those under temporary names included."""
        try:
            found: dict[str, _State] = {}
            for path in self._folder.iterdir():
                if path.name == self._ignored:
                    continue
                if path.is_symlink():
                    self._links.add(path.name)
                elif path.is_file() and (state := _state_of(path)) and state.size:
                    found[path.name] = state
        except OSError as error:  # a drive that is gone
            if not self._folder.is_dir():
                raise DeviceError(f"the folder {self._folder} of {self._device} is gone; check the drive") from error
            return dict(self._listed)
        self._listed = found
        return dict(found)


class _Before:
    """The files that were there when the unit arrived."""

    def __init__(self, files: dict[str, _State]) -> None:
        self._files = dict(files)
        self._missed: set[int] = set()

    def of(self, name: str, state: _State) -> _State | None:
        """Return the state that a file had then, whatever its name was; None if it was not there."""
        if state.inode:
            return next((old for old in self._files.values() if old.inode == state.inode), None)
        return self._files.get(name)

    def was_changed(self, name: str, state: _State) -> bool:
        """Return whether a file was there then and is not as it was."""
        old = self.of(name, state)
        return old is not None and old != state

    def forget_removed(self, there: dict[str, _State]) -> None:
        """Forget files that are gone: the system gives their inodes to new ones.

        Only what is missing twice is gone, since a file may be given another name while the folder is listed.
        """
        inodes = {state.inode for state in there.values()}
        missing = {state.inode for state in self._files.values() if state.inode} - inodes
        gone = missing & self._missed
        self._files = {name: state for name, state in self._files.items() if state.inode not in gone or not state.inode}
        self._missed = missing


class _Watch:
    """Since when files have been as they are."""

    def __init__(self) -> None:
        self._since: dict[str, tuple[_State, float]] = {}

    def see(self, files: dict[str, _State], now: float) -> None:
        """Note the states of files."""
        for name, state in files.items():
            if name not in self._since or self._since[name][0] != state:
                self._since[name] = state, now

    def is_at_rest(self, name: str, state: _State, now: float) -> bool:
        """Return whether a file has not changed for a while."""
        self.see({name: state}, now)
        return now - self._since[name][1] >= _STABLE_S

    def again(self, name: str, now: float) -> None:
        """Watch a file for another while."""
        self._since[name] = self._since[name][0], now


def _is_finished(name: str) -> bool:
    """Return whether a name is that of a file and not of one that is still written, or hidden."""
    return not name.startswith(".") and not name.lower().endswith(_TEMPORARY)


def _state_of(path: Path) -> _State | None:
    try:
        status = path.lstat()
    except OSError:
        return None
    if not stat.S_ISREG(status.st_mode):
        return None
    return _State(status.st_ino, status.st_size, status.st_mtime_ns)


def _copy(folder: Path, name: str, target: Path) -> None:
    """Copy a file of a folder, durably.

    Raises:
        FileNotFoundError: if it is gone, or a symbolic link is in its place.
        OSError: if it cannot be copied.
    """
    with _opened(folder, name) as source, open(target, "wb") as copy:
        shutil.copyfileobj(source, copy, _BLOCK)
        copy.flush()
        os.fsync(copy.fileno())


def _opened(folder: Path, name: str) -> BinaryIO:
    """Open a file in or below a folder for reading, following no symbolic link on the way.

    Raises:
        FileNotFoundError: if it is gone, or a symbolic link is in its place.
    """
    parts = name.split("/")
    gone = FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), name)
    if os.open not in os.supports_dir_fd or not hasattr(os, "O_NOFOLLOW"):
        if any(folder.joinpath(*parts[: k + 1]).is_symlink() for k in range(len(parts))):
            raise gone
        return open(folder / name, "rb")
    at = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        for part in parts[:-1]:
            below = os.open(part, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW, dir_fd=at)
            os.close(at)
            at = below
        return os.fdopen(os.open(parts[-1], os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK, dir_fd=at), "rb")
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.ENOTDIR):  # a link was put in its place
            raise gone from None
        raise
    finally:
        os.close(at)
