"""The folder of a run: its plan, the pieces that are kept, and a record of each; it survives a crash at any moment.

    plan.json       the plan
    run.jsonl       a record a piece, synchronised to disk, after the piece itself
    pieces/NNN.npz  the lines of a stop or a pass, or a scan
    photos/NNN.*    a photograph a stop
    closure.*       the first stop measured again at the end, and whether it looked the same
    exchanges.jsonl every exchange with the devices
    stray/NNN/      copies of files that came before the unit had arrived at the stop

A piece counts once its record is there. A record whose piece is missing or changed does not count.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ladarreg_core.acquisition.devices.exchange_log import ExchangeLog
from ladarreg_core.acquisition.interfaces import PanTilt
from ladarreg_core.acquisition.line_sweep import LineSweep
from ladarreg_core.acquisition.plan import Plan, write_plan
from ladarreg_core.acquisition.plan_reading import plan_from_fields
from ladarreg_core.acquisition.run_records import (
    CLOSURE,
    RECORDS,
    Health,
    Record,
    in_degrees,
    read_closure,
    read_records,
)
from ladarreg_core.acquisition.runs.closure import Closure
from ladarreg_core.acquisition.runs.earlier_run import LOCK, PLAN, begin_anew, remove_set_aside, settle
from ladarreg_core.acquisition.runs.piece_list import ListedPiece
from ladarreg_core.acquisition.runs.sweep_pieces import read_sweeps
from ladarreg_core.errors import ExportError, FormatError, OptionError
from ladarreg_core.formats import read_scan
from ladarreg_core.formats.parsing.json_file import read_json_object, write_json
from ladarreg_core.formats.parsing.untrusted import shown_name
from ladarreg_core.scan import Scan
from ladarreg_core.storage.atomic_write import (
    AppendedFile,
    cannot_write,
    make_folder,
    replaced_file,
    sync_file,
    sync_folder,
    write_bytes,
)
from ladarreg_core.storage.folder_lock import FolderLock
from ladarreg_core.storage.moved_together import replace_together

PIECES, PHOTOS, STRAYS = "pieces", "photos", "stray"
_CLOSING = "closure.npz"


@dataclass(frozen=True, slots=True, eq=False)
class ScanPiece:
    """A piece of a mosaic."""

    scan: Scan
    at: PanTilt
    """Position read back."""


class RunFolder:
    """The folder of a run, for reading; use `open`.

    Attributes:
        path: the folder.
        plan: the plan.
        records: of the pieces that count, by their number.
        faults: what does not count, in sentences.
        closed: whether the first stop looked the same at the end; None if it was not measured again.
    """

    def __init__(self, path: Path, plan: Plan) -> None:
        self.path, self.plan = path, plan
        self.records: dict[int, Record] = {}
        self.faults: list[str] = []
        self.closed: bool | None = None

    @staticmethod
    def open(path: str | Path) -> RunFolder:
        """Open the folder of a run, complete or not.

        Raises:
            FormatError: if it is none.
        """
        folder = Path(path)
        settle(folder)
        if not (folder / PLAN).is_file():
            raise FormatError(f"{shown_name(folder)}: there is no {PLAN}; give the folder of a run")
        run = RunFolder(folder, _plan_of(folder / PLAN))
        run._read_records()
        return run

    @property
    def complete(self) -> bool:
        """Whether every stop of the plan has a piece."""
        from ladarreg_core.acquisition.runs.stops import stops_of

        return len(self.records) == len(stops_of(self.plan))

    def piece(self, index: int) -> LineSweep | ScanPiece:
        """Return a piece; of several lines of one stop the median of each ray.

        Raises:
            FormatError: if the file is damaged.
        """
        record = self.records[index]
        if self.plan.mode == "mosaic":
            return ScanPiece(read_scan(self.path / record.file), record.read)
        (sweep,), _ = read_sweeps([ListedPiece(index, self.path / record.file, record.read)])
        return sweep

    def _read_records(self) -> None:
        closure = read_closure(self.path)
        self.closed = None if closure is None else bool(closure["closed"])
        if not (self.path / RECORDS).is_file():
            return
        for record in read_records(self.path):
            if isinstance(record, FormatError):
                self.faults.append(f"{RECORDS}: {record}; its piece does not count")
            elif _is_whole(self.path, record):
                self.records[record.index] = record
            else:
                self.faults.append(f"{record.file} is missing or has changed; it does not count")
                self.records.pop(record.index, None)


@dataclass(frozen=True, slots=True, eq=False)
class RunSummary:
    """What a run has, by its records alone."""

    plan: Plan
    done: int
    """Pieces that are recorded and whose files are there."""
    total: int
    photos: tuple[tuple[Path, tuple[float, float]], ...]
    """Photographs, each with pan and tilt in degrees."""


def summary(path: str | Path) -> RunSummary:
    """Return what a run has, without looking into its pieces.

    Raises:
        FormatError: if the folder is none of a run.
    """
    from ladarreg_core.acquisition.runs.stops import stops_of

    folder = Path(path)
    settle(folder)
    if not (folder / PLAN).is_file():
        raise FormatError(f"{shown_name(folder)}: there is no {PLAN}; give the folder of a run")
    plan = _plan_of(folder / PLAN)
    records: dict[int, Record] = {}
    for record in read_records(folder) if (folder / RECORDS).is_file() else ():
        if isinstance(record, Record) and (folder / record.file).is_file():
            records[record.index] = record
    kept = [records[index] for index in sorted(records)]
    photos = [(folder / one.photo, one.read) for one in kept if one.photo is not None]
    return RunSummary(
        plan, len(kept), len(stops_of(plan)),
        tuple((file, (in_degrees(at)[0], in_degrees(at)[1])) for file, at in photos if file.is_file()),
    )  # fmt: skip


class RunWriter(RunFolder):
    """The folder of a run that is under way; use `begin`, and close it."""

    def __init__(self, path: Path, plan: Plan, lock: FolderLock) -> None:
        super().__init__(path, plan)
        self._lock = lock
        self._log: AppendedFile | None = None
        self.exchanges = ExchangeLog(path)
        """The log of the exchanges with the devices."""

    @staticmethod
    def begin(path: str | Path, plan: Plan, *, resume: bool = False, force: bool = False) -> RunWriter:
        """Begin a run in a folder of its own, or resume the one that is there.

        With `force`, an earlier run is set aside, and removed when the new one is closed and complete.

        Raises:
            OptionError: if there is a run and neither `resume` nor `force` is set, there is none to resume, its plan
                differs, or the folder of a run to replace has files that are not its own.
            ExportError: if the folder cannot be written, or another program runs in it.
        """
        folder = Path(path)
        settle(folder)
        there = (folder / PLAN).is_file()
        if resume and not there:
            raise OptionError(f"{shown_name(folder)} has no run to resume; leave out `resume`")
        if not resume and folder.exists() and any(folder.iterdir()) and not (there and force):
            what = "has a run already: set `resume` to go on with it, or give another folder" if there else (
                "is not empty; give a new folder"
            )  # fmt: skip
            raise OptionError(f"{shown_name(folder)} {what}")
        try:
            make_folder(folder)
        except OSError as error:
            raise ExportError(
                f"{shown_name(folder)} cannot be created: {error.strerror}; give another folder"
            ) from None
        lock = FolderLock(folder, LOCK, what="run")
        try:
            if resume:
                _require_same(_plan_of(folder / PLAN), plan, folder)
            else:
                begin_anew(folder, lambda path: write_plan(path, plan))
            make_folder(folder / PIECES)
            run = RunWriter(folder, plan, lock)
            run.faults += [lock.remark] if lock.remark else []
            run._read_records()
            run._open_log()
        except BaseException as error:
            lock.release()
            if isinstance(error, OSError):
                raise cannot_write(folder, error) from None
            raise
        return run

    def keep(
        self, index: int, write: Callable[[Path], None], *, asked: PanTilt, read: PanTilt, time: str, passed: int = 0,
        photo: Path | None = None, strays: Sequence[Path] = (), health: Health | None = None,
    ) -> Record:  # fmt: skip
        """Keep a piece: its file whole on disk first, then its record.

        Args:
            index: number of the stop.
            write: writes the piece's file to a path.
            asked: position asked for.
            read: position read back.
            time: UTC, ISO 8601.
            passed: number of the pass.
            photo: a photograph of the stop, in the folder `photos`.
            strays: files that came before it, in the folder `stray`.
            health: what the devices state about themselves.

        Raises:
            ExportError: if it cannot be written; it does not count then.
        """
        file = f"{PIECES}/{index:03d}.npz"
        with replaced_file(self.path / file) as new:
            write(new)
        name = None if photo is None else photo.relative_to(self.path).as_posix()
        try:
            self._sync([*([] if photo is None else [photo]), *strays])
            photo_sha256 = "" if photo is None else _sha256(photo)
            aside = {path.relative_to(self.path).as_posix(): _sha256(path) for path in strays}
            sha256 = _sha256(self.path / file)
        except OSError as error:
            raise cannot_write(self.path, error) from None
        record = Record(index, file, sha256, asked, read, time, passed, name, photo_sha256, aside, health or Health())
        assert self._log is not None
        self._log.append(json.dumps(record.as_fields()).encode() + b"\n")
        self.records[index] = record
        return record

    def keep_closure(self, closure: Closure, write: Callable[[Path], None]) -> None:
        """Keep what the first stop looked like at the end.

        Args:
            closure: what came of comparing it.
            write: writes the measurement to a path.

        Raises:
            ExportError: if it cannot be written.
        """
        replace_together(self.path, {_CLOSING: write, CLOSURE: lambda path: write_json(path, closure.as_fields())})
        self.closed = closure.closed

    def close(self) -> None:
        """Close the folder for other programs to go on."""
        if self._log is not None:
            self._log.close()
        self.exchanges.close()
        if self.complete:
            remove_set_aside(self.path)
        self._lock.discard()

    def _sync(self, files: Sequence[Path]) -> None:
        """Bring files in the folder to disk, with the names that lead to them."""
        for file in files:
            sync_file(file)
        depth = len(self.path.parts)
        for parent in {parent for file in files for parent in file.parents if len(parent.parts) >= depth}:
            sync_folder(parent)

    def _open_log(self) -> None:
        """Open the list of records, without the rest of one that was being written."""
        path = self.path / RECORDS
        data = path.read_bytes() if path.is_file() else b""
        intact = data.rfind(b"\n") + 1
        if not path.is_file():
            write_bytes(path, b"")
            sync_folder(self.path)
        self._log = AppendedFile(path, intact_bytes=intact)


def write_sweep(path: Path, sweep: LineSweep) -> None:
    """Write the lines of a stop, or of the pass of a moving unit, as `sweep_pieces` reads them."""
    arrays: dict[str, Any] = {"ranges": sweep.ranges_m, "angles_rad": sweep.angles_rad}
    if sweep.intensity is not None:
        arrays["intensity"] = sweep.intensity
    if sweep.ray_time_s is not None and sweep.track is not None:
        times = sweep.ray_time_s
        arrays |= {
            "time_s": times[:, 0], "sweep_s": np.median(times[:, -1] - times[:, 0]), "unit_time_s": sweep.track.time_s,
            "unit_pan_rad": sweep.track.pan_rad, "unit_tilt_rad": sweep.track.tilt_rad,
        }  # fmt: skip
    else:
        arrays |= {"pan_rad": sweep.pan_rad[0], "tilt_rad": sweep.tilt_rad[0]}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    write_bytes(path, buffer.getvalue())


def _plan_of(path: Path) -> Plan:
    """Return the plan of a run; its watched folders need not be there any more."""
    return plan_from_fields(read_json_object(path, "a plan"), folders_exist=False)


def _require_same(before: Plan, now: Plan, folder: Path) -> None:
    """Refuse to resume a run with a plan that gives other pieces; ports and speeds may differ."""
    old: Mapping[str, Any] = before.as_fields()
    new: Mapping[str, Any] = now.as_fields()
    whole = ("mode", "pan_deg", "tilt_deg", "continuous", "passes", "mount", "settle_s")
    differing = [name for name in whole if old[name] != new[name]]
    for part, free in (
        ("unit", ("port", "baud", "speed_deg_s")),
        ("scanner", ("port", "baud", "folder", "timeout_s", "trigger")),
    ):
        mine, theirs = ({k: v for k, v in fields[part].items() if k not in free} for fields in (old, new))
        differing += [part] if mine != theirs else []
    if differing:
        raise OptionError(
            f"the plan differs in {', '.join(differing)} from that of the run in {shown_name(folder)}; resume it "
            "with its own plan, or begin a new run in another folder"
        )


def _is_whole(folder: Path, record: Record) -> bool:
    """Return whether a piece is as it was kept; records written by hand may leave out the checksum."""
    path = folder / record.file
    return path.is_file() and record.sha256 in ("", _sha256(path))


def _sha256(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
