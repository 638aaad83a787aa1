"""Files that were dropped together: kept until all of a batch is there, understood together, and opened in order."""

from __future__ import annotations

import json
import logging
import secrets
import shutil
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from ladarreg_core.errors import FormatError, LadarregError, OptionError, UnderspecifiedError

from ..argument_names import as_fields
from ..session.isolated_readers import READERS
from ..session.loader import Loader
from ..session.session import Session
from .batch_plan import BatchFile, PhotoTarget, Reason, Step, plan_batch, with_companions
from .clients import Client
from .files import Files
from .selection import Selection

log = logging.getLogger(__name__)
ANY = "any"
"""Kind of an upload whose content decides."""
_INDEX = "waiting.json"
_MOST_WAITING = 200
_BATCH_ARRIVES_S = 60.0
"""Files that no page has opened after this time are offered to all."""
_NOT_OPENED = Reason("uploaded, but not opened yet", needs_choice=True)


class Batches:
    """The files that wait to be opened; they outlive the page and the program.

    Args:
        session: the session.
        loader: its loader.
        files: opens files.
        selection: the photograph that each client sees.
        on_change: called after files have arrived or gone.
    """

    def __init__(
        self,
        session: Session,
        loader: Loader,
        files: Files,
        selection: Selection,
        on_change: Callable[[], None],
    ) -> None:
        self._session, self._loader, self._files = session, loader, files
        self._selection, self._on_change = selection, on_change
        self._lock = threading.RLock()
        self._paths: dict[str, Path] = {}
        self._waiting: dict[str, BatchFile] = {}
        self._reasons: dict[str, Reason] = {}
        self._arrived: dict[str, float] = {}
        self._restore()

    def take(self, path: Path, name: str) -> str:
        """Keep an uploaded file, and return its id; one of an unknown format is deleted.

        Raises:
            LadarregError: if its format is unknown, or too many files wait.
        """
        from ladarreg_core.formats import survey_file

        try:
            if len(self._waiting) >= _MOST_WAITING:
                raise OptionError(f"{_MOST_WAITING} files wait to be opened; open or remove some first")
            survey = READERS.run(survey_file, path)
            file = BatchFile(path.stem, name, path.stat().st_size, survey)
        except BaseException:
            path.unlink(missing_ok=True)
            raise
        with self._lock:
            self._waiting[file.id], self._paths[file.id] = file, path
            self._arrived[file.id] = time.monotonic()
            self._save()
        self._on_change()
        return file.id

    def open(
        self,
        ids: Sequence[str],
        *,
        replace_scan: bool = False,
        photo: str | None = None,
        reading: Mapping[str, Any] | None = None,
        client: Client | None = None,
    ) -> dict[str, Any]:
        """Open files together with those that waited for them.

        Args:
            ids: the files; ids of files that are gone are ignored.
            replace_scan: whether a scan may replace the one of the project.
            photo: id of the photograph that cameras and matches belong to; None: the one that the files suggest.
            reading: options of `read_scan` for the scan among them.
            client: who opens them.

        Returns:
            `opened`: `[{file, kind, photo?}]`, `refused`: `[{file, name, error}]`, `waiting`: ids, and, if nothing was
            opened because the operator has to choose, `asks`: `scan`.
        """
        with self._lock:
            document, shown = self._session.document, self._selection.photo_of(client)
            wanted = set(ids)
            files = [f for f in self._waiting.values() if f.id in wanted or (photo is None and self._may_settle(f))]
            files = with_companions(files, list(self._waiting.values()))
            plan = plan_batch(
                files,
                self._photos(),
                shown=shown.id if shown else None,
                has_scan=document.scan is not None,
                photo=photo,
            )
            self._reasons |= plan.waiting
            scans = [step.file for step in plan.steps if step.file.survey.kind == "scan"]
            if scans and document.scan is not None and not replace_scan:
                kept = Reason(f"the project has a scan already, {document.scan.name}", needs_choice=True)
                self._reasons |= {file.id: kept for file in files if file.id not in plan.waiting}
                found: dict[str, Any] = {"opened": [], "refused": [], "asks": "scan", "scan": scans[0].name}
            else:
                found = self._execute(plan.steps, reading or {}, client)
            self._save()
            found["waiting"] = [file.id for file in files if file.id in self._waiting]
        self._on_change()
        return found

    def discard(self, ids: Sequence[str]) -> None:
        """Delete files that wait."""
        with self._lock:
            for file_id in ids:
                path = self._paths.get(file_id)
                if path is not None:
                    path.unlink(missing_ok=True)
                self._forget(file_id)
            self._save()
        self._on_change()

    def give(self, ids: Sequence[str], folder: Path) -> list[tuple[Path, str]]:
        """Move waiting files to the folder for uploads of another project; return their paths there and names."""
        given = []
        with self._lock:
            for file_id in ids:
                file, path = self._waiting.get(file_id), self._paths.get(file_id)
                if file is not None and path is not None:
                    given.append((path.replace(folder / path.name), file.name))
                    self._forget(file_id)
            self._save()
        self._on_change()
        return given

    def slice(self) -> list[dict[str, Any]]:
        """Return the slice `waiting`.

        It is computed without the lock, which a batch holds while its edits are published: whoever publishes at that
        moment would wait for it for ever.
        """
        listed = []
        for file in list(self._waiting.values()):
            reason = self._reason(file)
            if reason is not None:
                kind = "part" if reason.part_of else file.survey.kind
                known = {"id": file.id, "name": file.name, "size": file.size}
                takes = list(file.survey.takes) if reason.is_underspecified else []
                listed.append({**known, "kind": kind, "said": reason.said, "lacks": self._lacks(file), "takes": takes})
                if takes and file.survey.scans:
                    listed[-1]["scans"] = list(file.survey.scans)
        return listed

    def _reason(self, file: BatchFile) -> Reason | None:
        """Return why a file waits; None while the rest of its batch is probably still arriving."""
        reason = self._reasons.get(file.id)
        if reason is None:
            return _NOT_OPENED if time.monotonic() - self._arrived.get(file.id, 0.0) > _BATCH_ARRIVES_S else None
        return _NOT_OPENED if reason.part_of and reason.part_of not in self._waiting else reason

    def _may_settle(self, file: BatchFile) -> bool:
        """Return whether a file waits for others that may have arrived."""
        reason = self._reasons.get(file.id)
        return reason is not None and not reason.needs_choice

    def _lacks(self, file: BatchFile) -> list[str]:
        names = {other.name.casefold() for other in self._waiting.values()}
        return [name for name in file.survey.names if name.rpartition("/")[2].casefold() not in names]

    def _photos(self) -> list[PhotoTarget]:
        found = []
        for entry in self._session.document.photos:
            try:
                width, height = self._loader.viewable_photo(entry).camera.size
            except LadarregError:
                width = height = 0
            found.append(PhotoTarget(entry.id, entry.source.name, width, height))
        return found

    def _execute(self, steps: Sequence[Step], reading: Mapping[str, Any], client: Client | None) -> dict[str, Any]:
        opened: list[dict[str, Any]] = []
        refused: list[dict[str, Any]] = []
        made: dict[str, str] = {}
        for step in steps:
            file, path = step.file, self._paths[step.file.id]
            kind = file.survey.kind
            try:
                if kind == "scan":
                    _require_choice(file, reading)
                    self._open_scan(step, path, reading, client)
                    opened.append({"file": file.id, "kind": kind})
                for photo in step.photos or ((None,) if kind == "photo" else ()):
                    target = made.get(photo or "", photo)
                    found = self._files.open(path, file.name, kind, target, client, reading)
                    made[file.id] = found
                    opened.append({"file": file.id, "kind": kind, "photo": found})
            except LadarregError as error:
                said = as_fields(str(error)).replace(str(path), file.name).replace(path.name, file.name)
                refused.append({"file": file.id, "name": file.name, "error": said})
                if isinstance(error, UnderspecifiedError) and not step.companions:
                    self._reasons[file.id] = Reason(said, needs_choice=True, is_underspecified=True)
                    continue
                if not self._files.is_in_project(path):
                    path.unlink(missing_ok=True)
            for each in (file, *step.companions.values()):
                self._forget(each.id)
        return {"opened": opened, "refused": refused}

    def _open_scan(self, step: Step, path: Path, reading: Mapping[str, Any], client: Client | None) -> None:
        """Open a scan; a descriptor gets a folder of its own, with the files that it names under these names."""
        name = step.file.name
        if not step.companions:
            self._files.open(path, name, "scan", None, client, reading)
            return
        folder = path.parent / secrets.token_hex(16)
        try:
            folder.mkdir()
            descriptor = path.replace(folder / "scan.json")
            for named, companion in step.companions.items():
                target = folder / named  # its parts were checked when the descriptor was surveyed
                target.parent.mkdir(parents=True, exist_ok=True)
                self._paths[companion.id].replace(target)
            self._files.open(descriptor, name, "scan", None, client, reading)
        except BaseException as error:
            shutil.rmtree(folder, ignore_errors=True)
            if isinstance(error, OSError):
                raise FormatError(f"the files of {name} cannot be stored: {error.strerror or error}") from None
            if isinstance(error, LadarregError):
                raise type(error)(str(error).replace("scan.json", name)) from None
            raise

    def _forget(self, file_id: str) -> None:
        for kept in (self._waiting, self._paths, self._reasons, self._arrived):
            kept.pop(file_id, None)

    def _save(self) -> None:
        """Write the names of the waiting files, so that they are still offered after a restart."""
        index = self._session.folder.inputs / _INDEX
        names = [{"file": self._paths[f.id].name, "name": f.name} for f in self._waiting.values()]
        try:
            if names:
                index.write_text(json.dumps(names), encoding="utf-8")
            else:
                index.unlink(missing_ok=True)
        except OSError as error:  # they are offered until the program ends
            log.warning("the names of waiting files cannot be saved: %s", error)

    def _restore(self) -> None:
        from ladarreg_core.formats import survey_file

        folder = self._session.folder.inputs
        with suppress(OSError, ValueError, KeyError, TypeError):
            for entry in json.loads((folder / _INDEX).read_text(encoding="utf-8")):
                path = folder / Path(entry["file"]).name
                if not path.is_file() or self._files.is_in_project(path):
                    continue
                with suppress(LadarregError):
                    file = BatchFile(path.stem, str(entry["name"]), path.stat().st_size, READERS.run(survey_file, path))
                    self._waiting[file.id], self._paths[file.id] = file, path
                    self._reasons[file.id] = _NOT_OPENED


def _require_choice(file: BatchFile, reading: Mapping[str, Any]) -> None:
    """Ask which scan of a file is meant.

    Raises:
        UnderspecifiedError: if it contains several, and none was chosen.
    """
    if file.survey.scans and "scan_index" not in reading:
        raise UnderspecifiedError(f"it contains {len(file.survey.scans)} scans; choose the one to open")
