"""Saved results: folders with a `registration.json`, opened again together with the files that they were made of."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import msgspec

from ladarreg_core.errors import ExportError, FormatError, LadarregError, OptionError
from ladarreg_core.export.json import find_inputs, is_recorded
from ladarreg_core.export.output_frame import FrameName, OutputFrame
from ladarreg_core.export.outputs.placed_scans import PlacedScan
from ladarreg_core.export.registered_scan import Registered, RegisteredPhoto, RegisteredScan, RegisteredSurvey, photo_id
from ladarreg_core.formats import read_photo, read_scan
from ladarreg_core.formats.documents.registration_file import read_result
from ladarreg_core.formats.scans.scan_request import ScanOptions, stated_options
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.photo import Photo
from ladarreg_core.results.registration import Registration
from ladarreg_core.scan import Scan

RESULT_FILE = "registration.json"
"""The file by which a folder of results is recognised."""
_DAMAGED = "give an unmodified one"
_MAX_SUBFOLDERS = 500


class _PhotoReading(msgspec.Struct):
    """Recorded arguments of `read_photo`."""

    camera: str | msgspec.UnsetType = msgspec.UNSET
    camera_name: str | msgspec.UnsetType = msgspec.UNSET
    focal_px: float | msgspec.UnsetType = msgspec.UNSET
    focal_mm: float | msgspec.UnsetType = msgspec.UNSET
    sensor_mm: float | msgspec.UnsetType = msgspec.UNSET
    camera_model: Literal["pinhole", "equirectangular"] | msgspec.UnsetType = msgspec.UNSET
    temperature_unit: Literal["K", "C", "none"] | msgspec.UnsetType = msgspec.UNSET


@dataclass(frozen=True, slots=True, eq=False)
class SavedResult:
    """A `registration.json`, and how the files were read that it was made of."""

    file: Path
    """The `registration.json`."""
    registration: Registration
    """The result with its matches; of a refused one with the best guess as its pose."""
    document: Mapping[str, Any]
    """The whole document."""
    inputs: Sequence[Mapping[str, Any]]
    """Documents of the input files: the scan, the photograph, and others."""
    scan_options: Mapping[str, Any]
    """The recorded arguments of `read_scan`; empty in results of earlier versions."""
    photo_options: Mapping[str, Any] | None
    """The recorded arguments of `read_photo`, a camera file by its name; None in results of earlier versions."""
    within: Sequence[Path] | None = None
    """Folders that inputs are found in by the paths that the result states; None: anywhere."""

    @property
    def photo_name(self) -> str:
        """The photograph's file name."""
        return str(self.inputs[1].get("name"))

    def find(
        self, folders: Sequence[Path], *, scan_file: Path | None = None, option: str = "`inputs`"
    ) -> tuple[Path, Path]:
        """Return the files of scan and photograph, see `find_inputs`; `scan_file` must be that of the scan.

        Raises:
            ExportError: if one is not found, or only files of its name with another content.
        """
        near = self._near(folders)
        if scan_file is None:
            scan = self._find(self.inputs[0], near, option=option)
        else:
            (scan,) = find_inputs(self.inputs[:1], [scan_file], option=option)
        return scan, self._find(self.inputs[1], near, option=option)

    def find_scan(self, record: Mapping[str, Any], folders: Sequence[Path], *, option: str = "`inputs`") -> Path:
        """Return the file of another scan of the same survey, looked for where this result's files are.

        Raises:
            ExportError: if it is not found.
        """
        return self._find(record, self._near(folders), option=option)

    def _find(self, record: Mapping[str, Any], near: Sequence[Path], *, option: str = "`inputs`") -> Path:
        """Return the file of an input, which lies in a folder or where the result states it.

        Raises:
            ExportError: if it is not found.
        """
        return find_inputs([record], near, beside=self.file.parent, within=self.within, option=option)[0]

    def camera_file(self, folders: Sequence[Path]) -> Path | None:
        """Return the camera file, if there was one and it is found."""
        name = (self.photo_options or {}).get("camera")
        record = next((one for one in self.inputs[2:] if one.get("name") == name), None)
        if name is None or record is None:
            return None
        try:
            return self._find(record, self._near(folders))
        except ExportError:
            return None

    def _near(self, folders: Sequence[Path]) -> list[Path]:
        near = [*folders, self.file.parent, self.file.resolve().parent.parent, Path.cwd()]
        return [*near, *(inner for folder in near for inner in _subfolders(folder))]

    def read_scan(self, file: Path, given: Mapping[str, Any] | None = None, *, report: Report | None = None) -> Scan:
        """Read the scan as it was read for the result.

        Args:
            file: the scan's file.
            given: arguments of `read_scan`; those that differ from its defaults precede the recorded ones.
            report: receives the progress.

        Raises:
            LadarregError: as `read_scan`.
        """
        return read_scan(file, report=report, **self.scan_reading(given, scan_file=file))

    def scan_reading(self, given: Mapping[str, Any] | None = None, *, scan_file: Path | None = None) -> dict[str, Any]:
        """Return the arguments of `read_scan`: the recorded ones, and those `given` that are no defaults.

        Raises:
            ExportError: if further files of the standpoint were recorded and are not found, beside `scan_file` or in
                the folders of the result.
        """
        found = {**self.scan_options, **_changed(given)}
        if found.get("more"):
            near = self._near_scan(scan_file)
            found["more"] = tuple(self._find(record, near) for record in self._further_scans)
        return found

    def further_scans(self, scan_file: Path) -> tuple[list[Path], list[str]]:
        """Return the further files of the standpoint that were accumulated with the scan.

        Args:
            scan_file: the scan's file; they are looked for beside it and in the folders of the result.

        Returns:
            The files that are found, recognised by their SHA-256, and the names of those that are not.
        """
        found: list[Path] = []
        missing: list[str] = []
        for record in self._further_scans:
            try:
                found.append(self._find(record, self._near_scan(scan_file)))
            except ExportError:
                missing.append(str(record.get("name")))
        return found, missing

    @property
    def _further_scans(self) -> list[Mapping[str, Any]]:
        names = self.scan_options.get("more", ())
        recorded = [one for one in self.inputs[2:] if one.get("name") in names]
        known = {one.get("name") for one in recorded}
        return [*recorded, *({"name": name} for name in names if name not in known)]

    def _near_scan(self, scan_file: Path | None) -> list[Path]:
        return self._near([] if scan_file is None else [scan_file.parent])

    def read_photo(self, file: Path, *, temperature_unit: str | None = None) -> Photo:
        """Read the photograph as it was read for the result, with the camera of the result.

        Args:
            file: the photograph's file.
            temperature_unit: precedes the recorded unit.

        Raises:
            LadarregError: as `read_photo`.
        """
        recorded = dict(self.photo_options or {})
        unit: Any = temperature_unit or recorded.pop("temperature_unit", None)
        camera = self.registration.camera
        if self.photo_options is None or "camera" in recorded:  # its size says whether pixels are raw
            return read_photo(file, camera=camera, temperature_unit=unit)
        photo = read_photo(file, **{**recorded, "temperature_unit": unit})
        if photo.camera.size != camera.size:
            raise FormatError(f"{self.file}: its camera is {camera.size}, the photo {photo.camera.size}; {_DAMAGED}")
        return replace(photo, camera=camera)


def _subfolders(folder: Path) -> list[Path]:
    """Return the first folders in a folder, by name, without hidden ones and those that cannot be listed."""
    try:
        with os.scandir(folder) as listed:
            names = sorted(entry.name for entry in listed if entry.is_dir() and not entry.name.startswith("."))
    except OSError:
        return []
    return [folder / name for name in names[:_MAX_SUBFOLDERS]]


def is_saved_result(folder: Path) -> bool:
    """Return whether a folder has a `registration.json`."""
    return (folder / RESULT_FILE).is_file()


def read_saved_result(
    folder: str | Path, *, trust_edited: bool = False, within: Sequence[Path] | None = None
) -> SavedResult:
    """Read a folder of results, or its `registration.json`.

    Args:
        folder: the folder or the file.
        trust_edited: read a result that was changed after it was written, as a pose that was given.
        within: as `SavedResult.within`.

    Raises:
        FormatError: if it is none, is damaged, or was changed after it was written.
    """
    file = Path(folder) / RESULT_FILE if Path(folder).is_dir() else Path(folder)
    registration, document = read_result(file, trust_edited=trust_edited)
    inputs = document.get("inputs")
    if not isinstance(inputs, list) or len(inputs) < 2 or not all(isinstance(one, dict) for one in inputs):
        raise FormatError(f"{file} does not name the scan and the photo that it was made of")
    try:
        scan = _recorded_scan(inputs[0])
        photo = _recorded(inputs[1], _PhotoReading)
    except (msgspec.ValidationError, OptionError) as error:
        raise FormatError(f"{file}: the options of an input are damaged ({error}); {_DAMAGED}") from None
    return SavedResult(file, registration, document, inputs, scan or {}, photo, within)


def recorded_options(result: Path, scan: Path, photo: Path) -> dict[str, Any]:
    """Return the options that a result records of a scan and a photograph, if it was made of them.

    Args:
        result: a `registration.json`; of any other file, such as a pose, the options are empty.
        scan: the scan's file.
        photo: the photograph's file.

    Returns:
        Arguments of `read_scan` and `read_photo` by their names, without the camera file and further scans, see
        `recorded_scans`; those of a file with another content than the recorded one are left out.
    """
    try:
        saved = read_saved_result(result, trust_edited=True)
        found = dict(saved.scan_options) if is_recorded(scan, saved.inputs[0]) else {}
        if is_recorded(photo, saved.inputs[1]):
            found |= saved.photo_options or {}
    except (LadarregError, OSError):  # each file is read again, and refused, where it is needed
        return {}
    return {name: value for name, value in found.items() if name not in ("camera", "camera_name", "more")}


def recorded_scans(result: Path, scan: Path, *, within: Sequence[Path] | None = None) -> tuple[list[Path], list[str]]:
    """Return the further files that a result records as accumulated with a scan, if it was made of that scan.

    Args:
        result: a `registration.json`; any other file, such as a pose, records none.
        scan: the scan's file.
        within: as `SavedResult.within`.

    Returns:
        See `SavedResult.further_scans`.
    """
    try:
        saved = read_saved_result(result, trust_edited=True, within=within)
        return saved.further_scans(scan) if is_recorded(scan, saved.inputs[0]) else ([], [])
    except (LadarregError, OSError):  # as in `recorded_options`
        return [], []


def missing_scans(result: Path, scan: Path, more: Sequence[Path], *, within: Sequence[Path] | None = None) -> str:
    """Return a sentence on the clouds that a result was made of and that are not found; empty: none is missing.

    Args:
        result: a file that may be a result.
        scan: the scan's file.
        more: the further clouds that are read with it.
        within: as `SavedResult.within`.
    """
    found, missing = recorded_scans(result, scan, within=within)
    if not missing or len(more) >= len(found) + len(missing):
        return ""
    clouds = "this cloud is" if not more else f"{1 + len(more)} clouds are"
    return (
        f"{result} was registered on {1 + len(found) + len(missing)} accumulated clouds; {', '.join(missing)} "
        f"{'was' if len(missing) == 1 else 'were'} not found beside {scan.name} or the result, and only {clouds} "
        "used; give all clouds with their folders"
    )


def registered_results(
    results: Sequence[SavedResult],
    *,
    placed: Sequence[PlacedScan] = (),
    folders: Sequence[Path] = (),
    scan_file: Path | None = None,
    scan_options: Mapping[str, Any] | None = None,
    temperature_unit: str | None = None,
    frame: FrameName = "scanner",
    option: str = "`inputs`",
    report: Report | None = None,
) -> Registered:
    """Return results to be exported together, their inputs read again.

    Results on several scans are those of a survey: each states where its scanner stands in the world.

    Args:
        results: the results, accepted, given or refused; refused ones are listed as such.
        placed: scans of the survey, see `placed_scans`; those without results follow the others.
        folders: where inputs are looked for before the folders of the results, the folders above them, and the working
            folder; a file among them stands for itself. Files are recognised by their SHA-256.
        scan_file: the scan's file; None: it is looked for.
        scan_options: arguments of `read_scan` for results that do not record them.
        temperature_unit: unit of the pixels of thermal photographs whose results do not record it.
        frame: of written points and poses; those of a survey are in the world.
        option: how to give a folder, for messages.
        report: receives the progress of reading, with the files' names.

    Raises:
        OptionError: if there is no result, they are on different scans that do not all stand in one world, or the
            frame is `world` and the scan does not state where it stands.
        ExportError: if an input is not found.
        LadarregError: if an input cannot be read.
    """
    if not results:
        raise OptionError("there is no result to export; give one or several folders of results")
    groups = _by_scan(results, scan_options)
    on = {_of_scan(group[0].inputs[0]) for group in groups}
    others = list({key: one for one in placed if (key := _of_scan(one.input)) not in on}.values())
    several = len(groups) + len(others)
    if several > 1 and scan_file is not None:
        raise OptionError(f"the results are on {several} scans, and one file is given for them; give their folder")
    opened = _Opened(tuple(folders), scan_file, dict(scan_options or {}), temperature_unit, option, report)
    if several == 1:
        scan, reading, file = opened.scan(groups[0])
        return opened.registered(groups[0], scan, reading, file, OutputFrame.of(scan, frame), "scan", [])
    found: list[RegisteredScan] = []
    read: list[tuple[Sequence[SavedResult], tuple[Scan, dict[str, Any], Path]]] = [
        (group, opened.scan(group)) for group in groups
    ]
    beside = read[0][1][2].parent
    read += [([], opened.other_scan(one, groups[0][0], beside)) for one in others]
    for group, (scan, reading, file) in read:
        own = OutputFrame.of(scan, "world")
        in_world = replace(own, offset_m=found[0].frame.offset_m) if found else own
        taken = [one.id for other in found for one in (*other.photos, *other.refused)]
        name = photo_id(file.name, [one.id for one in found])
        found.append(opened.registered(group, scan, reading, file, in_world, name, taken, of_survey=True))
    return RegisteredSurvey(found)


@dataclass(frozen=True, slots=True, eq=False)
class _Opened:
    """Reads what results were made of."""

    folders: Sequence[Path]
    scan_file: Path | None
    scan_options: Mapping[str, Any]
    temperature_unit: str | None
    option: str
    report: Report | None

    def scan(self, results: Sequence[SavedResult]) -> tuple[Scan, dict[str, Any], Path]:
        """Return the scan of some results where a survey put it, how it was read, and its file."""
        first = results[0]
        file, _ = first.find(self.folders, scan_file=self.scan_file, option=self.option)
        reading = first.scan_reading(self.scan_options, scan_file=file)
        scan = read_scan(file, report=self.report, **reading)
        world = first.registration.world_from_scanner
        if first.registration.method == "survey" and world is not None:
            scan = replace(scan, world_from_scanner=world)
        return scan, reading, file

    def other_scan(self, placed: PlacedScan, result: SavedResult, beside: Path) -> tuple[Scan, dict[str, Any], Path]:
        """Return a scan of a survey as `scan`, its file found as those of one of the results, or in a folder."""
        file = result.find_scan(placed.input, [*self.folders, beside], option=self.option)
        reading = {**(_recorded_scan(placed.input) or {}), **_changed(self.scan_options)}
        scan = read_scan(file, report=self.report, **reading)
        return replace(scan, world_from_scanner=placed.world_from_scanner), reading, file

    def registered(
        self, results: Sequence[SavedResult], scan: Scan, reading: dict[str, Any], scan_file: Path,
        frame: OutputFrame, name: str, taken: Sequence[str], *, of_survey: bool = False,
    ) -> RegisteredScan:  # fmt: skip
        """Return a scan with the photographs of its results."""
        photos: list[RegisteredPhoto] = []
        files = [one.find(self.folders, scan_file=self.scan_file, option=self.option)[1] for one in results]
        for done, (one, file) in enumerate(zip(results, files, strict=True)):
            if self.report is not None:
                self.report(Progress(done, len(results), f"reading {file.name}"))
            photos.append(
                RegisteredPhoto(
                    photo_id(file.name, [*taken, *(other.id for other in photos)]),
                    one.read_photo(file, temperature_unit=self.temperature_unit),
                    replace(one.registration, world_from_scanner=scan.world_from_scanner),
                    file,
                    one.camera_file(self.folders),
                    dict(one.photo_options or {}),
                    _document_of(one),
                )
            )
        return RegisteredScan(
            scan,
            [one for one in photos if one.registration.is_shown],
            scan_file,
            reading,
            frame,
            [one for one in photos if not one.registration.is_shown],
            id=name,
            of_survey=of_survey,
        )


def _document_of(result: SavedResult) -> Callable[[], Mapping[str, Any]]:
    return lambda: result.document


def _by_scan(results: Sequence[SavedResult], scan_options: Mapping[str, Any] | None) -> list[list[SavedResult]]:
    """Return the results by their scans, in the order of these files' names.

    Raises:
        OptionError: if there are several scans that do not all stand in one world.
    """
    groups: dict[str, list[SavedResult]] = {}
    for one in results:
        reading = {**one.scan_options, **_changed(scan_options)}
        groups.setdefault(f"{one.inputs[0].get('sha256')} {sorted(reading.items())}", []).append(one)
    found = sorted(groups.values(), key=lambda one: (str(one[0].inputs[0].get("name")), _index(one[0])))
    if len(found) > 1 and any(one.registration.world_from_scanner is None for one in results):
        first, other = found[0][0], found[1][0]
        if first.inputs[0].get("sha256") == other.inputs[0].get("sha256"):
            raise OptionError(
                f"{first.file.parent} and {other.file.parent} read {first.inputs[0].get('name')} with different "
                "options (another scan of the file, or another origin); export each by itself"
            )
        names = ", ".join(f"{result.file.parent} ({result.inputs[0].get('name')})" for result in (first, other))
        raise OptionError(
            f"the results are on different scans: {names}, and not all state where the scanner stands in one "
            "world; export the results of each by itself, or solve them as a survey"
        )
    return found


def _index(result: SavedResult) -> int:
    return int(result.scan_options.get("scan_index") or 0)


def _of_scan(record: Mapping[str, Any]) -> tuple[Any, int]:
    """Return the content of a scan's file, and which of its scans is meant."""
    return record.get("sha256"), int((_recorded_scan(record) or {}).get("scan_index") or 0)


def _recorded(record: Mapping[str, Any], kind: type[msgspec.Struct]) -> dict[str, Any] | None:
    """Return the options that an input document records; None if it is of an earlier version."""
    fields = record.get("read_with")
    if fields is None:
        return None
    found = msgspec.convert(fields, kind)
    values = {name: getattr(found, name) for name in kind.__struct_fields__}
    return {name: value for name, value in values.items() if value is not msgspec.UNSET}


def _recorded_scan(record: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the recorded arguments of `read_scan`, `more` among them; None in results of earlier versions."""
    fields = record.get("read_with")
    if fields is None:
        return None
    fields = msgspec.convert(fields, dict[str, Any])
    more = {"more": msgspec.convert(fields["more"], tuple[str, ...])} if "more" in fields else {}
    return {**stated_options(fields), **more}


def _changed(given: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return the arguments of `read_scan` that are no defaults."""
    return {} if given is None else ScanOptions(**given).given()
