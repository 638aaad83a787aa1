"""The pieces of a run, or of a list written by hand: which file was measured at which pan and tilt."""

from __future__ import annotations

import csv
import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ladarreg_core.acquisition.interfaces import PanTilt
from ladarreg_core.acquisition.mount_fields import base_from_value, base_sigma_from_value, mount_from_fields
from ladarreg_core.acquisition.plan import Mode
from ladarreg_core.acquisition.run_records import RECORDS, position_of, read_closure, read_records
from ladarreg_core.acquisition.runs.earlier_run import settle
from ladarreg_core.errors import FormatError
from ladarreg_core.formats.parsing.json_file import read_json_object
from ladarreg_core.formats.parsing.untrusted import inside_folder, one_line, reading, shown_name
from ladarreg_core.foundations.validation import is_int, is_number
from ladarreg_core.frames import Rigid

PLAN_FILE = "plan.json"
_COLUMNS = ("file", "pan_deg", "tilt_deg")
_MAX_BYTES = 64 << 20
_READ_BYTES = 1 << 20


@dataclass(frozen=True, slots=True)
class ListedPiece:
    """One piece of a run."""

    index: int
    """Its place in the plan, or in the list."""
    path: Path
    """Its file."""
    at: PanTilt
    """Where the unit was, as read back; for a pass of a moving unit, where it began."""
    sha256: str | None = None
    """Of its file, as recorded."""

    def checked_sha256(self) -> str:
        """Return the SHA-256 of the file.

        Raises:
            FormatError: if the file is missing, or not the one that was recorded.
        """
        with reading(self.path) as file, open(file, "rb") as stream:
            digest = hashlib.sha256()
            while block := stream.read(_READ_BYTES):
                digest.update(block)
            found = digest.hexdigest()
            if self.sha256 is not None and found != self.sha256:
                raise FormatError(
                    "it is not the file that was recorded (its SHA-256 differs); restore it, or remove its line from "
                    f"{RECORDS} and resume the run"
                )
        return found


@dataclass(frozen=True, slots=True)
class PieceList:
    """The pieces of a run."""

    source: Path
    """The run's folder, or the list."""
    mode: Mode
    pieces: tuple[ListedPiece, ...]
    """In the order of their indices."""
    mount: Rigid | None
    """`unit_from_scanner` of the plan, if there is a plan."""
    planned: int | None
    """Number of pieces planned; None: unknown."""
    base: Rigid | None = None
    """`level_from_unit` of the plan, if it states one."""
    base_sigma_deg: tuple[float, float] | None = None
    """Standard deviations of its roll and pitch, deg, if the plan states them."""
    closure: Mapping[str, Any] | None = None
    """Whether the first stop looked the same at the end, as `closure.json` says; None if nobody looked."""

    @property
    def missing(self) -> tuple[int, ...]:
        """The indices of planned pieces that were not measured."""
        there = {piece.index for piece in self.pieces}
        return tuple(index for index in range(self.planned or 0) if index not in there)


def is_run_folder(path: Path) -> bool:
    """Return whether a path is a folder with the records of a run."""
    return (path / RECORDS).is_file()


def read_piece_list(path: str | Path) -> PieceList:
    """Read the pieces of a run folder, or of a CSV with the columns `file,pan_deg,tilt_deg`.

    A run folder has `run.jsonl` with one record a line; `plan.json` may be missing if the records were written by
    hand. Files of a CSV are relative to its folder.

    Raises:
        FormatError: if there is no such file, or it says anything else; all lines are checked.
    """
    place = Path(path)
    if place.is_dir():
        return _of_run(place)
    with reading(place) as file:
        if file.stat().st_size > _MAX_BYTES:
            raise FormatError(f"it has {file.stat().st_size:,} bytes; a list of pieces is shorter: give the right file")
        return PieceList(place, "mosaic", _of_csv(file), None, None)


def _of_run(folder: Path) -> PieceList:
    settle(folder)
    if not is_run_folder(folder):
        raise FormatError(
            f"the folder {shown_name(folder)} contains no {RECORDS}; give the folder of a run of "
            "`ladarreg acquire`, or a CSV with file,pan_deg,tilt_deg"
        )
    mode, mount, base, sigma_deg, planned = _plan_of(folder / PLAN_FILE)
    found: dict[int, ListedPiece] = {}
    for record in read_records(folder):
        if isinstance(record, FormatError):
            raise FormatError(f"{shown_name(folder / RECORDS)}: {record}")
        path = inside_folder(folder, record.file, "the file")
        found[record.index] = ListedPiece(record.index, path, record.read, record.sha256 or None)
    if not found:
        raise FormatError(f"the folder {shown_name(folder)} has no piece yet; resume the run")
    pieces = tuple(found[index] for index in sorted(found))
    return PieceList(folder, mode, pieces, mount, planned, base, sigma_deg, read_closure(folder))


def _of_csv(file: Path) -> tuple[ListedPiece, ...]:
    try:
        text = file.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise FormatError("it is not UTF-8 text; a list of pieces is a CSV with file,pan_deg,tilt_deg") from None
    rows = [row for row in csv.reader(text.splitlines(), skipinitialspace=True) if any(cell.strip() for cell in row)]
    head = [name.strip().lower() for name in rows[0]] if rows else []
    if not {*_COLUMNS} <= {*head}:
        raise FormatError("its first line names no columns; a list of pieces begins with file,pan_deg,tilt_deg")
    places = [head.index(name) for name in _COLUMNS]
    found: list[ListedPiece] = []
    for number, row in enumerate(rows[1:], 2):
        if len(row) < len(head):
            raise FormatError(f"line {number} has {len(row)} values; it needs {len(head)}")
        name, pan, tilt = (row[place].strip() for place in places)
        if not name or "\0" in name:
            raise FormatError(f"line {number} names no file")
        try:
            at = position_of(float(pan), float(tilt), f"line {number}")
        except ValueError:
            raise FormatError(
                f"line {number} has the angles {one_line(pan, 20)!r} and {one_line(tilt, 20)!r}; they must be degrees"
            ) from None
        found.append(ListedPiece(len(found), file.parent / name, at))
    if not found:
        raise FormatError("it lists no piece; each line needs file,pan_deg,tilt_deg")
    return tuple(found)


def _plan_of(path: Path) -> tuple[Mode, Rigid | None, Rigid | None, tuple[float, float] | None, int | None]:
    """Return mode, mount, base with its sigmas, and number of pieces of a plan; of a run without a plan, a mosaic's."""
    if not path.is_file():
        return "mosaic", None, None, None, None
    with reading(path) as file:
        fields = read_json_object(file, "a plan")
        mode = fields.get("mode")
        if mode not in ("sweep", "mosaic"):
            raise FormatError(f"its mode is {one_line(repr(mode), 40)}; it must be sweep or mosaic")
        mount = mount_from_fields(fields["mount"]) if "mount" in fields else None
        stated = fields["mount"].get("base") if mount is not None else None
        base = None if stated is None else base_from_value(stated)
        sigma = fields["mount"].get("base_sigma_deg") if mount is not None else None
        sigma_deg = None if sigma is None else base_sigma_from_value(sigma)
        return "sweep" if mode == "sweep" else "mosaic", mount, base, sigma_deg, _planned(fields)


def _planned(fields: Mapping[str, Any]) -> int | None:
    counts = []
    for name in ("pan_deg", "tilt_deg"):
        axis = fields.get(name)
        if not (isinstance(axis, list) and len(axis) == 3 and all(map(is_number, axis))):
            return None
        width, step = abs(axis[1] - axis[0]), abs(axis[2])
        counts.append(1 if step == 0 or width == 0 else math.floor(width / step + 1e-6) + 1)
    passes = fields.get("passes", 1)
    passes = int(passes) if is_int(passes) and passes > 0 else 1
    if fields.get("mode") == "sweep" and fields.get("continuous"):
        counts[0] = 1
    return counts[0] * counts[1] * passes
