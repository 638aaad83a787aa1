"""The records of a run, `run.jsonl`: one JSON object a line, one line a piece, read alike by all that read a run."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ladarreg_core.acquisition.interfaces import PanTilt
from ladarreg_core.errors import FormatError
from ladarreg_core.formats.parsing.json_file import read_json_object
from ladarreg_core.formats.parsing.untrusted import inside_folder, one_line, reading
from ladarreg_core.foundations.validation import is_int, is_number

RECORDS, CLOSURE = "run.jsonl", "closure.json"
_MAX_BYTES = 64 << 20
_MAX_PIECES = 1_000_000


@dataclass(frozen=True, slots=True)
class Health:
    """What the devices stated about themselves when a piece was kept, if anything."""

    unit: Mapping[str, float] = field(default_factory=dict)
    """`volts` of the pan/tilt unit's supply, `celsius` of its case."""
    clock: Mapping[str, float] = field(default_factory=dict)
    """`scanner_s`, the scanner's clock, unwrapped; `host_minus_scanner_s`, by which this computer's clock differed from
    it when the two were compared last, and how far off that may be, `uncertainty_s`."""


@dataclass(frozen=True, slots=True)
class Record:
    """What `run.jsonl` says of a piece."""

    index: int
    """Number of the stop in the order of the plan."""
    file: str
    """Relative to the run's folder."""
    sha256: str
    """Of the file; empty if it was not recorded, as in records written by hand."""
    asked: PanTilt
    read: PanTilt
    """Position read back."""
    time: str
    """UTC, ISO 8601."""
    passed: int = 0
    photo: str | None = None
    photo_sha256: str = ""
    """Of the photograph; empty in records of earlier versions."""
    strays: Mapping[str, str] = field(default_factory=dict)
    """SHA-256 of each file that came before the unit had arrived, by its name relative to the run's folder."""
    health: Health = field(default_factory=Health)
    """Only written, for diagnosis; nothing is computed from it."""

    def as_fields(self) -> dict[str, Any]:
        """Return the record's JSON object."""
        fields: dict[str, Any] = {
            "index": self.index, "file": self.file, "sha256": self.sha256, "asked_deg": in_degrees(self.asked),
            "read_deg": in_degrees(self.read), "time": self.time, "pass": self.passed,
        }  # fmt: skip
        if self.photo is not None:
            fields |= {"photo": self.photo, "photo_sha256": self.photo_sha256}
        more = {"strays": self.strays, "unit": self.health.unit, "clock": self.health.clock}
        return {**fields, **{name: dict(value) for name, value in more.items() if value}}


def read_records(folder: Path) -> Iterator[Record | FormatError]:
    """Yield the records of a run in their order, and for each line that is none what it has instead.

    A last line without an end is left out: the program was killed while it wrote it.

    Raises:
        FormatError: if the list cannot be read, or is too long for one.
    """
    if (folder / RECORDS).is_file() and not (folder / RECORDS).stat().st_size:
        return  # a run that has just begun
    with reading(folder / RECORDS) as file:
        if file.stat().st_size > _MAX_BYTES:
            raise FormatError(f"it has {file.stat().st_size:,} bytes; the records of a run are shorter")
        lines = file.read_bytes().split(b"\n")
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        try:
            yield _record(folder, json.loads(line), f"line {number}")
        except (ValueError, RecursionError):
            if number < len(lines):
                yield FormatError(f"line {number} is not a JSON object; restore it or remove it")
        except FormatError as error:
            yield error


def read_closure(folder: Path) -> Mapping[str, Any] | None:
    """Return what the first stop of a run looked like at the end; None if it was not measured again.

    Raises:
        FormatError: if the file says nothing of the kind.
    """
    if not (folder / CLOSURE).is_file():
        return None
    with reading(folder / CLOSURE) as file:
        fields = read_json_object(file, "the closure of a run")
        if not isinstance(fields.get("closed"), bool) or not isinstance(fields.get("said"), str):
            raise FormatError("it does not say whether the run has closed; remove it and resume the run")
        return {**fields, "said": one_line(fields["said"], 400)}


def position_of(pan_deg: float, tilt_deg: float, where: str) -> PanTilt:
    """Return a position that a list states in degrees.

    Raises:
        FormatError: if these are no angles of a unit.
    """
    if not (math.isfinite(pan_deg) and math.isfinite(tilt_deg) and abs(pan_deg) <= 720 and abs(tilt_deg) <= 180):
        raise FormatError(f"{where} has pan {pan_deg:g} and tilt {tilt_deg:g} deg; they must be angles in degrees")
    return PanTilt(float(np.radians(pan_deg)), float(np.radians(tilt_deg)))


def in_degrees(at: PanTilt) -> list[float]:
    """Return a position as [pan, tilt] in degrees."""
    return [float(np.degrees(at.pan_rad)), float(np.degrees(at.tilt_rad))]


def _record(folder: Path, fields: object, where: str) -> Record:
    if not isinstance(fields, Mapping):
        raise FormatError(f"{where} is not a JSON object")
    index = fields.get("index")
    if index is None or not is_int(index) or not 0 <= int(index) < _MAX_PIECES:
        raise FormatError(f"{where} has the index {one_line(repr(index), 40)}; it must be a whole number from 0")
    read = fields.get("read_deg", fields.get("asked_deg"))
    sha256, passed, photo = fields.get("sha256") or "", fields.get("pass", 0), fields.get("photo")
    photo_sha256 = fields.get("photo_sha256") or ""
    if not isinstance(sha256, str) or not isinstance(photo_sha256, str):
        raise FormatError(f"{where} has a sha256 that is not a text")
    if not is_int(passed) or int(passed) < 0:
        raise FormatError(f"{where} has the pass {one_line(repr(passed), 40)}; it must be a whole number from 0")
    strays = fields.get("strays") or {}
    if not (isinstance(strays, Mapping) and all(isinstance(each, str) for each in strays.values())):
        raise FormatError(f"{where} has strays that are not names with a SHA-256 each")
    for name in strays:
        inside_folder(folder, name, f"a stray file of {where}")
    at = _position(read, where)
    inside_folder(folder, fields.get("file"), f"the file of {where}")
    if photo is not None:
        inside_folder(folder, photo, f"the photograph of {where}")
    return Record(
        int(index), str(fields["file"]), sha256, _position(fields.get("asked_deg", read), where), at,
        str(fields.get("time", "")), int(passed), None if photo is None else str(photo), photo_sha256, strays,
    )  # fmt: skip


def _position(value: object, where: str) -> PanTilt:
    if not (isinstance(value, list) and len(value) == 2 and all(map(is_number, value))):
        raise FormatError(f"{where} has no read_deg with pan and tilt in degrees")
    return position_of(value[0], value[1], where)
