"""The folder of a run: resumed if it is one, else created; nothing in it that others wrote is ever replaced."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

from ladarreg_core.batches.photos.journal import JOURNAL_FILE, Journal
from ladarreg_core.errors import ExportError, FormatError
from ladarreg_core.export.targets.folder import check_folder
from ladarreg_core.storage.atomic_write import cannot_write, make_folder, write_bytes
from ladarreg_core.storage.folder_lock import FolderLock
from ladarreg_core.storage.manifest import MANIFEST_FILE, manifest_bytes, read_manifest, remove_listed
from ladarreg_core.storage.moved_together import finish_moves, replace_together
from ladarreg_core.storage.replacement import display_path, folder_content, remove_results, require_apart
from ladarreg_core.storage.staging import clear_leftovers

PHOTOS_FOLDER = "photos"
"""Folder in that of a run with a folder of results for each photograph."""
SUMMARY_FILE = "adjustment.json"
"""File with the result of a run."""
PAGE_FILE = "index.html"
"""Page that summarises a run."""


@dataclass(frozen=True, slots=True)
class RunKind:
    """How the folder of a kind of runs is laid out."""

    journal: str
    """Name of its journal."""
    results: str
    """Folder with a folder of results for each task."""
    summary: str
    """File with the result of the run."""
    what: str
    """What a task is, for messages, in the plural."""


PHOTOS_RUN = RunKind(JOURNAL_FILE, PHOTOS_FOLDER, SUMMARY_FILE, "photos")
"""Photographs of one scan, or of a survey."""
_LOCK_FILE, _WHAT = ".lock", "folder"
_MAX_NAMED = 3


def is_batch_folder(folder: str | Path, kind: RunKind = PHOTOS_RUN) -> bool:
    """Return whether a folder is that of a run of a kind, finished or not."""
    return (Path(folder) / kind.journal).is_file() and (kind is PHOTOS_RUN or (Path(folder) / MANIFEST_FILE).is_file())


class BatchFolder:
    """The folder of a run, locked while it is open; use it in a `with` statement.

    A run that is interrupted leaves what it has finished, and a folder with nothing of that is removed.

    Args:
        folder: the folder. One of an earlier run is resumed; any other that exists is refused, or with `force` replaced
            if it contains nothing but results.
        inputs: files and folders that may not lie in it.
        force: see `folder`.
        kind: of the run.

    Raises:
        ExportError: if the folder must not be used, see `check_folder`, or another program works in it.
        FormatError: if it is a damaged folder of a run.
    """

    def __init__(
        self, folder: str | Path, *, inputs: Sequence[str | Path] = (), force: bool = False,
        kind: RunKind = PHOTOS_RUN,
    ) -> None:  # fmt: skip
        self.folder = Path(os.path.abspath(folder))
        self.kind = kind
        self._made = False
        if not is_batch_folder(self.folder, kind):
            self._make(inputs, force=force)
        require_apart(self.folder, inputs=inputs)
        finish_moves(self.folder, lock=_LOCK_FILE, what=_WHAT)
        self._lock = FolderLock(self.folder, _LOCK_FILE, what=_WHAT)
        try:
            self.journal = Journal(self.folder / kind.journal)
            self.results = self.folder / kind.results
            make_folder(self.results)
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
        if self._made and not self.journal and not (self.folder / self.kind.summary).exists():  # nothing was finished
            with contextlib.suppress(OSError, FormatError):
                self.results.rmdir()
                remove_listed(self.folder, besides=(self.kind.journal,))

    @property
    def photos(self) -> Path:
        """The folder with a folder of results for each photograph."""
        return self.results

    def clear_leftovers(self) -> None:
        """Remove what killed processes left among the folders of results."""
        clear_leftovers(self.results)

    def require_replaceable(self, changed: Collection[str], *, force: bool) -> None:
        """Refuse to replace results of other inputs or options without `force`.

        Args:
            changed: names of tasks with such results.
            force: whether they may be replaced.

        Raises:
            ExportError: naming them.
        """
        if force or not changed:
            return
        names = sorted(changed)
        more = f" and {len(names) - _MAX_NAMED} more" if len(names) > _MAX_NAMED else ""
        raise ExportError(
            f"the folder {display_path(self.folder)} contains results of other {self.kind.what}, inputs or options "
            f"than these ({', '.join(names[:_MAX_NAMED])}{more}); give another folder, or allow them to be replaced by "
            "`force=True`"
        )

    def remove(self, name: str) -> None:
        """Remove the results of a task, as far as they are as they were written."""
        remove_results(self.results / name)

    def has_results(self, name: str) -> bool:
        """Return whether the results of a task are there as they were written."""
        folder = self.results / name
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
            Journal(self.folder / self.kind.journal).close()
        except OSError as error:
            raise cannot_write(display_path(self.folder), error) from None
