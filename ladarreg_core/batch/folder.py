"""The folder of a run: resumed if it is one, else created; nothing in it that others wrote is ever replaced."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from types import TracebackType

from ladarreg_core.batch.journal import JOURNAL_FILE, Journal
from ladarreg_core.errors import ExportError, FormatError
from ladarreg_core.export.targets.folder import check_folder
from ladarreg_core.storage.atomic_write import cannot_write, make_folder, write_bytes
from ladarreg_core.storage.folder_lock import FolderLock
from ladarreg_core.storage.manifest import MANIFEST_FILE, manifest_bytes, read_manifest
from ladarreg_core.storage.moved_together import finish_moves, replace_together
from ladarreg_core.storage.replacement import display_path, folder_content, remove_results, require_apart
from ladarreg_core.storage.staging import clear_leftovers

PHOTOS_FOLDER = "photos"
"""Folder in that of a run with a folder of results for each photograph."""
SUMMARY_FILE = "adjustment.json"
"""File with the result of a run."""
PAGE_FILE = "index.html"
"""Page that summarises a run."""
_LOCK_FILE, _WHAT = ".lock", "folder"
_MAX_NAMED = 3


def is_batch_folder(folder: str | Path) -> bool:
    """Return whether a folder is that of a run, finished or not."""
    return (Path(folder) / JOURNAL_FILE).is_file()


class BatchFolder:
    """The folder of a run, locked while it is open; use it in a `with` statement.

    A run that is interrupted leaves what it has finished, and a folder with nothing of that is removed.

    Args:
        folder: the folder. One of an earlier run is resumed; any other that exists is refused, or with `force` replaced
            if it contains nothing but results.
        inputs: files and folders that may not lie in it.
        force: see `folder`.

    Raises:
        ExportError: if the folder must not be used, see `check_folder`, or another program works in it.
        FormatError: if it is a damaged folder of a run.
    """

    def __init__(self, folder: str | Path, *, inputs: Sequence[str | Path] = (), force: bool = False) -> None:
        self.folder = Path(os.path.abspath(folder))
        self._made = False
        if not is_batch_folder(self.folder):
            self._make(inputs, force=force)
        require_apart(self.folder, inputs=inputs)
        finish_moves(self.folder, lock=_LOCK_FILE, what=_WHAT)
        self._lock = FolderLock(self.folder, _LOCK_FILE, what=_WHAT)
        try:
            self.journal = Journal(self.folder / JOURNAL_FILE)
            self.photos = self.folder / PHOTOS_FOLDER
            make_folder(self.photos)
            self.clear_leftovers()
        except OSError as error:
            self._lock.discard()
            raise cannot_write(self.folder, error) from None
        except BaseException:
            self._lock.discard()
            raise

    def __enter__(self) -> BatchFolder:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.clear_leftovers()
        self.journal.close()
        self._lock.discard()
        if self._made and not self.journal and not (self.folder / SUMMARY_FILE).exists():  # nothing was finished
            with contextlib.suppress(OSError):
                self.photos.rmdir()
                for name in (JOURNAL_FILE, MANIFEST_FILE):
                    (self.folder / name).unlink(missing_ok=True)
                self.folder.rmdir()

    def clear_leftovers(self) -> None:
        """Remove what killed processes left among the photographs' folders."""
        clear_leftovers(self.photos)

    def require_replaceable(self, changed: Collection[str], *, force: bool) -> None:
        """Refuse to replace results of other inputs or options without `force`.

        Args:
            changed: names of photographs with such results.
            force: whether they may be replaced.

        Raises:
            ExportError: naming them.
        """
        if force or not changed:
            return
        names = sorted(changed)
        more = f" and {len(names) - _MAX_NAMED} more" if len(names) > _MAX_NAMED else ""
        raise ExportError(
            f"the folder {display_path(self.folder)} contains results of other photos, inputs or options than these "
            f"({', '.join(names[:_MAX_NAMED])}{more}); give another folder, or allow them to be replaced by "
            "`force=True`"
        )

    def remove(self, photo: str) -> None:
        """Remove the results of a photograph, as far as they are as they were written."""
        remove_results(self.photos / photo)

    def has_results(self, photo: str) -> bool:
        """Return whether the results of a photograph are there as they were written."""
        folder = self.photos / photo
        try:
            content = folder_content(folder)
            listed = read_manifest(folder)
        except (OSError, FormatError):
            return False
        complete = listed is not None and all((folder / name).is_file() for name in listed)
        return content.document is not None and complete and not content.changed

    def write(self, files: Mapping[str, Callable[[Path], None]]) -> None:
        """Write the files of the run itself, all or none.

        Raises:
            ExportError: if one cannot be written, or was changed since the program wrote it.
        """
        replace_together(self.folder, files)

    def _make(self, inputs: Sequence[str | Path], *, force: bool) -> None:
        check_folder(self.folder, force=force, inputs=inputs)
        try:
            if self.folder.exists():
                remove_results(self.folder)
            make_folder(self.folder)
            self._made = True
            write_bytes(self.folder / MANIFEST_FILE, manifest_bytes(()))
            Journal(self.folder / JOURNAL_FILE).close()
        except OSError as error:
            raise cannot_write(display_path(self.folder), error) from None
