"""Whether a project, a result, a run or an export is as it was written: what `ladarreg check` says."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ladarreg_core.errors import FormatError, LadarregError
from ladarreg_core.storage.atomic_write import files_below
from ladarreg_core.storage.checksums import checksum_state
from ladarreg_core.storage.manifest import DOCUMENTS, MANIFEST_FILE, read_manifest

_RESULTS = {
    "registration.json": "result", "stations.json": "stations", "rig.json": "rig", "export.json": "export",
    "adjustment.json": "result", "comparison.json": "comparison", "panorama.json": "panorama",
    "batch.json": "result", "truth.json": "simulation", "model.json": "model",
}  # fmt: skip
_NO_MANIFEST = f"no manifest ({MANIFEST_FILE}), as of earlier versions: sizes and SHA-256 of the files are unknown"


@dataclass(frozen=True, slots=True)
class Integrity:
    """What was found of a folder or a file."""

    kind: str
    """`project`, `run`, `result`, `stations`, `rig`, `export`, `comparison`, `panorama`, `simulation`, `model` or
    `scan`."""
    files: int
    """Number of files that were compared with what was written."""
    damaged: tuple[str, ...] = ()
    """What is damaged, a sentence each."""
    notes: tuple[str, ...] = ()
    """What could not be compared, and other remarks."""


_PARTS = {"adjustment.json": "photos", "batch.json": "jobs"}
"""Where the folders lie that a document summarises."""


def check_integrity(path: str | Path) -> Integrity:
    """Compare a project, a result, a run or an export with its checksums; nothing is written.

    Args:
        path: its folder, a document of results, or an E57 file.

    Raises:
        FormatError: if it is none of these.
        OSError: if a file cannot be read.
    """
    from ladarreg_core.project.storage.folder import is_project

    place = Path(path)
    if not place.is_dir():
        return _of_file(place)
    kind = next((kind for name, kind in _RESULTS.items() if (place / name).is_file()), None)
    if (place / "run.jsonl").is_file() or (place / "plan.json").is_file():
        return _of_run(place)
    if kind is None and is_project(place):
        from ladarreg_core.project.storage.damage import project_damage

        damaged, notes = project_damage(place)
        return Integrity("project", sum(1 for _ in files_below(place)), tuple(damaged), tuple(notes))
    if kind is None and not (place / MANIFEST_FILE).is_file():
        raise FormatError(f"{place} is no project, result, run or export of ladarreg; give the folder of one")
    found = _of_results(place, kind or "result")
    for name, parts in _PARTS.items():
        if (place / name).is_file():
            found = _with_parts(found, place / parts)
    return found


def _with_parts(summary: Integrity, folder: Path) -> Integrity:
    """Return what was found of a summary together with what was of the folders that it summarises."""
    files, damaged, notes = summary.files, [*summary.damaged], [*summary.notes]
    for each in sorted(folder.glob("*/")):
        part = check_integrity(each) if (each / "adjustment.json").is_file() else _of_results(each, "result")
        files += part.files
        damaged += [f"{folder.name}/{each.name}/{line}" for line in part.damaged]
        notes += [f"{folder.name}/{each.name}: {line}" for line in part.notes]
    return Integrity(summary.kind, files, tuple(damaged), tuple(notes))


def _of_file(path: Path) -> Integrity:
    from ladarreg_core.formats.e57.header import read_e57_info, sniff_e57
    from ladarreg_core.formats.e57.pages import require_intact_pages
    from ladarreg_core.formats.parsing.untrusted import reading

    with reading(path) as file:
        with open(file, "rb") as stream:
            is_e57 = sniff_e57(stream.read(16))
        if not is_e57 and file.name not in DOCUMENTS:
            raise FormatError("it is no document of results and no E57; give the folder of a project, result or run")
    if not is_e57:
        damaged, notes = _of_document(path)
        return Integrity(_RESULTS[path.name], 1, tuple(damaged), tuple(notes))
    try:
        with reading(path) as file:
            read_e57_info(file)
            note = require_intact_pages(file)
    except LadarregError as error:
        return Integrity("scan", 1, (str(error),))
    return Integrity("scan", 1, (), (note,) if note else ())


def _of_run(folder: Path) -> Integrity:
    from ladarreg_core.acquisition.runs.run_folder import RunFolder
    from ladarreg_core.acquisition.runs.stops import stops_of

    try:
        run = RunFolder.open(folder)
    except LadarregError as error:
        return Integrity("run", 0, (str(error),))
    damaged = list(run.faults)
    photos = [one.photo for one in run.records.values() if one.photo is not None]
    damaged += [f"{name} is missing" for name in photos if not (folder / name).is_file()]
    planned = len(stops_of(run.plan))
    notes = [] if run.complete else [f"{len(run.records)} of {planned} pieces are there; the run can be resumed"]
    damaged += _unreadable(folder, [name for name in ("scan.npz",) if (folder / name).is_file()])
    return Integrity("run", len(run.records), tuple(damaged), tuple(notes))


def _of_results(folder: Path, kind: str) -> Integrity:
    damaged: list[str] = []
    notes: list[str] = []
    try:
        listed = read_manifest(folder)
    except FormatError as error:
        listed, damaged = None, [str(error)]
    else:
        if listed is None:
            notes.append(_NO_MANIFEST)
    documents = [name for name in DOCUMENTS if (folder / name).is_file()]
    for name in documents:
        own, said = _of_document(folder / name)
        damaged += own
        notes += said
    if listed is None:
        names = sorted({*_named_by(folder, documents), *(one.name for one in folder.iterdir() if one.is_file())})
        damaged += [f"{name} is missing" for name in names if not (folder / name).is_file()]
        damaged += _unreadable(folder, [name for name in names if (folder / name).is_file()])
        return Integrity(kind, len(documents), tuple(damaged), tuple(notes))
    wrong = {line.partition(":")[0] for line in damaged}
    for one in listed.values():
        fault = "" if one.name in wrong else one.fault(folder)
        if fault:
            damaged.append(f"{one.name} {fault}")
    return Integrity(kind, len(listed), tuple(damaged), tuple(notes))


def _of_document(path: Path) -> tuple[list[str], list[str]]:
    """Return what is damaged in a document of results, and notes."""
    from ladarreg_core.formats.documents.registration_file import read_result
    from ladarreg_core.formats.parsing.json_file import parsed_once, read_json_object
    from ladarreg_core.formats.parsing.untrusted import reading

    try:
        with reading(path) as file, parsed_once():
            state = checksum_state(read_json_object(file, "a document of results"))
            if state == "edited":
                return [f"{path.name}: it does not match its own checksum: it was edited or damaged"], []
            if path.name == "registration.json":
                read_result(path, trust_edited=True)
    except LadarregError as error:
        return [str(error)], []
    return [], [f"{path.name}: no checksum, as of earlier versions"] if state == "no checksum" else []


def _named_by(folder: Path, documents: Sequence[str]) -> list[str]:
    """Return the files that documents of earlier versions name."""
    from ladarreg_core.formats.parsing.json_file import read_json_object
    from ladarreg_core.storage.replacement import is_file_name

    found: list[Any] = []
    for name in documents:
        try:
            fields = read_json_object(folder / name, "a document of results")
        except LadarregError:
            continue  # said already
        files, stations = fields.get("files"), fields.get("stations")
        found += files if isinstance(files, list) else []
        found += [one.get("scan") for one in stations if isinstance(one, dict)] if isinstance(stations, list) else []
    return [one for one in found if isinstance(one, str) and is_file_name(one)]


def _unreadable(folder: Path, names: Sequence[str]) -> list[str]:
    """Return which files with checksums of their own are damaged: arrays in NPZ, pages of E57."""
    from ladarreg_core.formats.e57.pages import require_intact_pages

    damaged = []
    for name in names:
        path = folder / name
        try:
            if name.endswith(".npz"):
                with zipfile.ZipFile(path) as file:
                    wrong = file.testzip()
                if wrong is not None:
                    damaged.append(f"{name}: its array {wrong} is damaged")
            elif name.endswith(".e57"):
                require_intact_pages(path)
        except (zipfile.BadZipFile, EOFError, NotImplementedError, RuntimeError, ValueError):
            damaged.append(f"{name} is damaged: its arrays cannot be read")
        except FormatError as error:
            damaged.append(f"{name}: {error}")
    return damaged
