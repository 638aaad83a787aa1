"""A scanner or camera with software of its own: a folder in which a new file appears for each stop."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

from ladarreg_core.acquisition.clock import REAL_CLOCK, Clock
from ladarreg_core.acquisition.devices import Check
from ladarreg_core.errors import DeviceError

_NAP_S = 0.05
_STABLE_S = 0.7
_TEMPORARY = (".tmp", ".part", ".partial", ".crdownload", ".swp", ".lock", "~")
_Signature = tuple[int, int]


class FolderSource:
    """Waits for the next complete file of a folder.

    A file is complete when its size and time have not changed for a while and it can be read. Files that were there
    before, hidden and temporary ones are passed over; one that is replaced under its old name counts as new.

    Args:
        folder: the watched folder.
        is_readable: raises a `LadarregError` for a file that cannot be read as what is expected.
        timeout_s: longest wait for a file.
        device: what writes there, for messages.
        clock: what the waiting is measured by.
    """

    def __init__(
        self,
        folder: str | Path,
        *,
        is_readable: Callable[[Path], None],
        timeout_s: float,
        device: str,
        clock: Clock = REAL_CLOCK,
    ) -> None:
        self._folder, self._is_readable = Path(folder).expanduser(), is_readable
        self._timeout_s, self._device, self._clock = timeout_s, device, clock
        self._seen = self._files()

    def next_file(self, folder: Path, stem: str, *, check: Check) -> Path:
        """Await the next complete file and return its copy in `folder`, named `stem` with the file's own ending.

        Raises:
            DeviceError: if none comes in time, the folder is gone, or the file cannot be read.
            Cancelled: if `check` raises it.
        """
        begun = self._clock.now()
        watched: dict[str, tuple[_Signature, float]] = {}
        unreadable = ""
        while True:
            check()
            now = self._clock.now()
            for name, signature in self._files().items():
                if self._seen.get(name) == signature:
                    continue
                if name not in watched or watched[name][0] != signature:
                    watched[name] = signature, now
                elif now - watched[name][1] >= _STABLE_S:
                    path = self._folder / name
                    try:
                        self._is_readable(path)
                    except Exception as error:  # it may still be growing, by a writer that pauses
                        unreadable = str(error)
                        watched[name] = signature, now
                        if now - begun > self._timeout_s / 2:
                            self._seen[name] = signature
                            raise DeviceError(
                                f"{self._device} wrote {name}, which cannot be read ({unreadable}); measure again"
                            ) from error
                        continue
                    copy = folder / f"{stem}{path.suffix}"
                    shutil.copyfile(path, copy)
                    if self._files().get(name) != signature:
                        continue  # it was replaced meanwhile
                    self._seen = self._files()
                    return copy
            if now - begun > self._timeout_s:
                came = (
                    f"{', '.join(watched)} came but {'cannot be read: ' + unreadable if unreadable else 'is growing'}"
                )
                raise DeviceError(
                    f"{self._device} has written no complete file into {self._folder} within {self._timeout_s:.0f} s"
                    f"{' (' + came + ')' if watched else ''}; start its measurement, or check the folder, and resume"
                )
            self._clock.sleep(_NAP_S)

    def close(self) -> None:
        """Do nothing: a folder stays."""

    def _files(self) -> dict[str, _Signature]:
        try:
            found = {}
            for path in self._folder.iterdir():
                name = path.name
                if name.startswith(".") or name.lower().endswith(_TEMPORARY) or not path.is_file():
                    continue
                status = path.stat()
                if status.st_size:
                    found[name] = status.st_size, status.st_mtime_ns
            return found
        except OSError as error:  # a file that has just been renamed, or a drive that is gone
            if not self._folder.is_dir():
                raise DeviceError(f"the folder {self._folder} of {self._device} is gone; check the drive") from error
            return dict(self._seen) if hasattr(self, "_seen") else {}
