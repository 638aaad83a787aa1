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
from typing import TYPE_CHECKING, Any

from ladarreg_core.errors import FormatError, LadarregError, OptionError, UnderspecifiedError
from ladarreg_core.project.document import Document

from ...argument_names import as_fields
from ...session.isolated_readers import READERS
from ...session.loader import Loader
from ...session.session import Session
from ..state.clients import Client
from ..state.selection import Selection
from .batch_plan import BatchFile, PhotoTarget, Reason, Step, listed, plan_batch, with_companions
from .opening import Files, HowScans

if TYPE_CHECKING:
    from ...slices.project import WaitingFile

log = logging.getLogger(__name__)
ANY = "any"
"""Kind of an upload whose content decides."""
_INDEX = "waiting.json"
_DESCRIPTOR = "scan.json"
_MAX_WAITING = 200
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
            if len(self._waiting) >= _MAX_WAITING:
                raise OptionError(f"{_MAX_WAITING} files wait to be opened; open or remove some first")
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
        scans: HowScans | None = None,
        photo: str | None = None,
        reading: Mapping[str, Any] | None = None,
        client: Client | None = None,
    ) -> dict[str, Any]:
        """Open files together with those that waited for them.

        Args:
            ids: the files; ids of files that are gone are ignored.
            scans: what becomes of the scans among them; None: ask, unless there is one, the first of the project.
            photo: id of the photograph that cameras and matches belong to; None: the one that the files suggest.
            reading: options of `read_scan` for the scan among them, if it is one.
            client: who opens them.

        Returns:
            `opened`: `[{file, kind, photo?}]`, `refused`: `[{file, name, error}]`, `waiting`: ids, and, if nothing was
            opened because the operator has to choose, `asks`: `scan`, with `scans`: their names, and `said`: why the
            last choice was refused.
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
            found: dict[str, Any] = {"opened": [], "refused": []}
            steps = [step for step in plan.steps if step.file.survey.kind == "scan"]
            asked = self._files.asks_how([step.file.name for step in steps]) if steps else None
            try:
                if asked and scans is None:
                    raise _ToChooseError("")
                if asked and (len(steps) > 1 or scans != "replace"):
                    found["opened"] += self._open_together(steps, scans or "replace", reading or {}, client)
                    steps = []
                rest = [step for step in plan.steps if step.file.survey.kind != "scan"]
                self._execute([*steps, *rest], reading or {}, client, found)
            except _ToChooseError as error:
                self._reasons |= {
                    file.id: _undecided(file, steps, document, error) for file in files if file.id not in plan.waiting
                }
                found |= {**(asked or {}), **({"said": str(error)} if str(error) else {})}
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

    def slice(self) -> list[WaitingFile]:
        """Return the slice `waiting`.

        It is computed without the lock, which a batch holds while its edits are published: whoever publishes at that
        moment would deadlock.
        """
        listed: list[WaitingFile] = []
        for file in list(self._waiting.values()):
            reason = self._reason(file)
            if reason is not None:
                takes = list(file.survey.takes) if reason.is_underspecified else []
                listed.append({
                    "id": file.id, "name": file.name, "size": file.size,
                    "kind": "part" if reason.part_of else file.survey.kind, "said": reason.said,
                    "lacks": self._lacks(file), "takes": takes,
                })  # fmt: skip
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
                header = self._loader.header(entry)
                width, height = header.width, header.height
            except LadarregError:
                width = height = 0
            found.append(PhotoTarget(entry.id, entry.source.name, width, height))
        return found

    def _execute(
        self, steps: Sequence[Step], reading: Mapping[str, Any], client: Client | None, found: dict[str, Any]
    ) -> None:
        opened, refused = found["opened"], found["refused"]
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
                    its = self._files.open(path, file.name, kind, target, client, reading)
                    made[file.id] = its
                    opened.append({"file": file.id, "kind": kind, "photo": its})
            except LadarregError as error:
                said = as_fields(str(error)).replace(str(path), file.name).replace(path.name, file.name)
                refused.append({"file": file.id, "name": file.name, "error": said})
                if isinstance(error, UnderspecifiedError) and not step.companions:
                    self._reasons[file.id] = Reason(said, needs_choice=True, is_underspecified=True)
                    continue
                if not self._files.is_in_project(path):
                    path.unlink(missing_ok=True)
            self._forget_all(step)

    def _open_together(
        self, steps: Sequence[Step], how: HowScans, reading: Mapping[str, Any], client: Client | None
    ) -> list[dict[str, Any]]:
        """Open scans in one step of the history; return what was opened.

        Raises:
            _ToChooseError: why they cannot be opened like that; they wait for another choice.
        """
        placed: list[tuple[Path, str]] = []
        done = False
        try:
            for step in steps:
                if how != "stations" and step.file.survey.scans:
                    many = len(step.file.survey.scans)
                    raise FormatError(f"{step.file.name} contains {many} scans; add it as stations, or open it alone")
                placed.append((self._placed(step), step.file.name))
            self._files.open_scans(placed, how, client, reading)
            done = True
        except LadarregError as error:
            said = as_fields(str(error))
            for path, name in placed:
                said = said.replace(str(path), name).replace(path.name, name)
            raise _ToChooseError(said, is_underspecified=isinstance(error, UnderspecifiedError)) from None
        finally:
            for step, (path, _) in zip(steps, placed, strict=False):
                if not done:
                    self._take_back(step, path)
                elif not self._files.is_in_project(path):  # it was there already
                    _remove(path)
        for step in steps:
            self._forget_all(step)
        kind = {"frames": "frame", "stations": "station"}.get(how, "scan")
        return [{"file": step.file.id, "kind": kind} for step in steps]

    def _open_scan(self, step: Step, path: Path, reading: Mapping[str, Any], client: Client | None) -> None:
        name = step.file.name
        path = self._placed(step)
        try:
            self._files.open(path, name, "scan", None, client, reading)
        except BaseException as error:
            if step.companions:
                _remove(path)
            if isinstance(error, LadarregError):
                raise type(error)(str(error).replace("scan.json", name)) from None
            raise

    def _placed(self, step: Step) -> Path:
        """Return a scan's file; a descriptor gets a folder of its own, with the files that it names under these names.

        Raises:
            FormatError: if it cannot be stored.
        """
        path = self._paths[step.file.id]
        if not step.companions:
            return path
        folder = path.parent / secrets.token_hex(16)
        try:
            folder.mkdir()
            descriptor = path.replace(folder / _DESCRIPTOR)
            for named, companion in step.companions.items():
                target = folder / named  # its parts were checked when the descriptor was surveyed
                target.parent.mkdir(parents=True, exist_ok=True)
                self._paths[companion.id].replace(target)
        except OSError as error:
            shutil.rmtree(folder, ignore_errors=True)
            raise FormatError(f"the files of {step.file.name} cannot be stored: {error.strerror or error}") from None
        return descriptor

    def _take_back(self, step: Step, path: Path) -> None:
        """Undo `_placed`."""
        if not step.companions:
            return
        path.replace(self._paths[step.file.id])
        for named, companion in step.companions.items():
            (path.parent / named).replace(self._paths[companion.id])
        shutil.rmtree(path.parent, ignore_errors=True)

    def _forget_all(self, step: Step) -> None:
        for each in (step.file, *step.companions.values()):
            self._forget(each.id)

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


class _ToChooseError(LadarregError):
    """The operator has to choose what becomes of scans; the text says why the last choice was refused.

    Args:
        text: why.
        is_underspecified: whether it was refused because the files do not say all that reading them needs.
    """

    def __init__(self, text: str, *, is_underspecified: bool = False) -> None:
        super().__init__(text)
        self.is_underspecified = is_underspecified


def _remove(path: Path) -> None:
    """Remove the file of a scan, a descriptor with its folder."""
    if path.name == _DESCRIPTOR:
        shutil.rmtree(path.parent, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _undecided(file: BatchFile, scans: Sequence[Step], document: Document, error: _ToChooseError) -> Reason:
    """Return why a file waits until the operator has chosen what becomes of the scans."""
    for step in scans:
        if file in step.companions.values():
            return Reason(f"it is part of {step.file.name}", needs_choice=True, part_of=step.file.id)
    if file.survey.kind != "scan":
        names = listed([step.file.name for step in scans])
        return Reason(f"it is opened as soon as you choose what becomes of {names}", needs_choice=True)
    if str(error):
        return Reason(f"not opened: {error}", needs_choice=True, is_underspecified=error.is_underspecified)
    if document.scan is not None:
        return Reason(f"the project has a scan already, {document.scan.name}", needs_choice=True)
    names = listed([step.file.name for step in scans])
    return Reason(f"one of {len(scans)} scans, {names}: open them together, or this one alone", needs_choice=True)


def _require_choice(file: BatchFile, reading: Mapping[str, Any]) -> None:
    """Ask which scan of a file is meant.

    Raises:
        UnderspecifiedError: if it contains several, and none was chosen.
    """
    if file.survey.scans and "scan_index" not in reading:
        raise UnderspecifiedError(f"it contains {len(file.survey.scans)} scans; choose the one to open")
