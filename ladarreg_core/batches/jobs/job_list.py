"""Lists of jobs: a CSV or JSON of pairs and surveys, or folders with one job each; all faults are found at once."""

from __future__ import annotations

import glob
import json
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

from ladarreg_core.batches.jobs.job import Job, parsed_option
from ladarreg_core.batches.jobs.run_folder import JOBS_RUN
from ladarreg_core.batches.photos.folder import is_batch_folder
from ladarreg_core.batches.photos.photo_list import folder_contents
from ladarreg_core.errors import FormatError, LadarregError, OptionError
from ladarreg_core.formats.parsing.csv_table import read_csv_table
from ladarreg_core.formats.parsing.untrusted import one_line, reading, shown_name
from ladarreg_core.survey.parts import SurveyCamera, SurveyPhoto, SurveyScan
from ladarreg_core.survey.survey import Survey

_VERSION = 1
_MAX_BYTES = 256 << 20
_MAX_JOBS = 1_000_000
_MAX_SHOWN = 20
_SURVEY_FILE = "survey.json"
_NEEDS = "a CSV whose header names scan and photo, or survey, or such a list as JSON, or folders"
_OWN = ("name", "scan", "photo", "photos", "more", "survey")
_NOT_IN_NAMES = re.compile(r"[^\w.-]+")
JobSource: TypeAlias = str | Path


class JobListError(FormatError):
    """A list of jobs with faults; nothing was done."""

    def __init__(self, what: str, faults: Sequence[str]) -> None:
        self.faults = tuple(faults)
        """All of them, a sentence each."""
        shown = "; ".join(self.faults[:_MAX_SHOWN])
        more = f"; and {len(faults) - _MAX_SHOWN} more" if len(faults) > _MAX_SHOWN else ""
        count = "1 fault" if len(faults) == 1 else f"{len(faults)} faults"
        self.summary = f"{what} has {count}, and nothing was done"
        """Without the faults."""
        super().__init__(f"{self.summary}: {shown}{more}")
        self._what = what

    def __reduce__(self) -> tuple[Any, ...]:
        return JobListError, (self._what, self.faults)


def read_jobs(*sources: JobSource) -> list[Job]:
    """Return the jobs of a list, or of folders.

    A CSV has a header with `scan` and `photo`, or `survey`, and perhaps `name`, `more` (further scans, separated by
    `|`) and the names of options of `register`; an empty cell leaves an option out. JSON is a list of objects with such
    fields, or an object with `jobs`, `options` for all of them, and `version` 1; `photos` lists several of one scan.
    Paths start at the list's folder. A folder is one job: one scan with its photographs, or a survey.

    Args:
        sources: one file; or folders, or patterns of their names.

    Raises:
        JobListError: if something is wrong; all faults are listed, missing files among them.
        FormatError: if it is no such list.
    """
    if not sources:
        raise OptionError(f"there are no jobs; give {_NEEDS}")
    files = [Path(one) for one in sources if Path(one).is_file()]
    if files and len(sources) > 1:
        raise OptionError(f"{files[0]} is a file among {len(sources)} names; give one list of jobs, or folders only")
    jobs, faults = _of_file(files[0]) if files else _of_folders(sources)
    what = shown_name(files[0]) if files else "the list of folders"
    faults += faults_of_jobs(jobs)
    if not jobs and not faults:
        faults.append("it has no jobs")
    if faults:
        raise JobListError(what, faults)
    return jobs


def listed_jobs(path: Path) -> list[Job]:
    """Return the jobs of the list that a batch wrote; their files may be missing meanwhile.

    Raises:
        FormatError: if it is damaged.
    """
    jobs, faults = _of_file(path.resolve())
    if faults:
        raise JobListError(shown_name(path), faults)
    return [_with_paths(job, lambda file: Path(os.path.normpath(file))) for job in jobs]


def list_bytes(jobs: Sequence[Job], folder: Path) -> bytes:
    """Return the list of jobs as JSON that `read_jobs` reads from a file in a folder; paths start there if they can."""
    home = os.path.realpath(folder)

    def from_home(path: Path) -> Path:
        file = os.path.abspath(path)
        try:
            return Path(os.path.relpath(file, home))
        except ValueError:  # on another drive
            return Path(file)

    rows = []
    for job in (_with_paths(one, from_home) for one in jobs):
        photos = [path.as_posix() for path in job.photos]
        fields = {
            "name": job.id,
            "scan": None if job.scan is None else job.scan.as_posix(),
            "photo": photos[0] if job.kind == "pair" else None,
            "photos": photos if job.kind == "photos" else None,
            "more": [path.as_posix() for path in job.more] or None,
            "survey": None if job.survey is None else job.survey.as_posix(),
            **{name: value.as_posix() if isinstance(value, Path) else value for name, value in job.options.items()},
        }
        rows.append({name: value for name, value in fields.items() if value is not None})
    document = {"version": _VERSION, "jobs": rows}
    return (json.dumps(document, indent=1, allow_nan=False) + "\n").encode("utf-8")


def _with_paths(job: Job, of: Callable[[Path], Path]) -> Job:
    """Return a job with all its paths replaced."""
    options = {name: of(value) if isinstance(value, Path) else value for name, value in job.options.items()}
    return replace(
        job, scan=job.scan and of(job.scan), photos=tuple(map(of, job.photos)), more=tuple(map(of, job.more)),
        survey=job.survey and of(job.survey), options=options,
    )  # fmt: skip


def faults_of_jobs(jobs: Sequence[Job]) -> list[str]:
    """Return what is wrong with jobs, a sentence each, with the name of the job."""
    faults = []
    for one in jobs:
        found = one.faults()
        if not found and one.survey is not None:
            try:
                survey_inputs(one.survey)
            except LadarregError as error:
                found = [str(error)]
        faults += [f"{one.id}: {fault}" for fault in found]
    seen: dict[str, int] = {}
    for one in jobs:
        seen[one.id.lower()] = seen.get(one.id.lower(), 0) + 1
    return faults + [f"{count} jobs have the name {name}" for name, count in seen.items() if count > 1]


def survey_inputs(survey: Path) -> list[Path]:
    """Return the files that the result of a survey depends on.

    Raises:
        LadarregError: if it has faults.
    """
    parts = Survey.from_file(survey)
    files = [] if survey.is_dir() else [survey]
    members: list[SurveyScan | SurveyPhoto | SurveyCamera] = [*parts.scans, *parts.photos, *parts.cameras]
    for one in members:
        named: list[object] = [one.source, getattr(one, "matches", None), *getattr(one, "options", {}).values()]
        files += [value for value in named if isinstance(value, Path)]
    return list(dict.fromkeys(files))


def _of_file(path: Path) -> tuple[list[Job], list[str]]:
    with reading(path) as file:
        with open(file, "rb") as stream:
            is_json = stream.read(64).removeprefix(b"\xef\xbb\xbf").lstrip()[:1] in (b"{", b"[")
        rows = _rows_of_json(file) if is_json else _rows_of_csv(file)
        if len(rows) > _MAX_JOBS:
            raise FormatError(f"it has {len(rows):,} jobs; {_MAX_JOBS:,} are the most: divide it")
    names = _Names()
    jobs, faults = [], []
    for number, row in enumerate(rows, 1):
        job, wrong = _job_of_row(row, path.absolute().parent, names)
        faults += [f"job {number}: {one}" for one in wrong]
        if job is not None:
            jobs.append(job)
    return jobs, faults


def _rows_of_csv(file: Path) -> list[dict[str, Any]]:
    header, rows = read_csv_table(file, most_bytes=_MAX_BYTES, needs=_NEEDS)
    names = [one.replace("-", "_") for one in header]
    if not {"scan", "photo"} <= {*names} and "survey" not in names:
        raise FormatError(f"its header is {one_line(', '.join(header), 80)!r}; give {_NEEDS}")
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise FormatError(f"its header names {', '.join(twice)} twice; name each column once")
    found = []
    for row in rows:
        cells: dict[str, Any] = {name: cell for name, cell in zip(names, row, strict=False) if cell}
        if len(row) > len(names):
            cells["too many cells"] = len(row)
        found.append(cells)
    return found


def _rows_of_json(file: Path) -> list[dict[str, Any]]:
    if file.stat().st_size > _MAX_BYTES:
        raise FormatError(f"it is larger than {_MAX_BYTES >> 20} MB; divide it")
    try:
        fields = json.loads(file.read_bytes().decode("utf-8-sig"))
    except ValueError as error:
        raise FormatError(f"it is no JSON ({one_line(error, 80)}); give {_NEEDS}") from None
    common: Any = {}
    if isinstance(fields, dict):
        if "scans" in fields:
            raise FormatError("it is a survey; solve it by adjust, or name it in a list of jobs as survey")
        unknown = sorted({*fields} - {"version", "jobs", "options"})
        if unknown or fields.get("version", _VERSION) != _VERSION:
            what = f"unknown fields {one_line(', '.join(unknown), 80)}" if unknown else "another version"
            raise FormatError(f"it has {what}; a list of jobs has jobs, options, and version {_VERSION}")
        common, fields = fields.get("options", {}), fields.get("jobs")
    if not isinstance(fields, list) or not isinstance(common, dict):
        raise FormatError("it has no list of jobs; give an object for each job, with scan and photo, or survey")
    rows = []
    for one in fields:
        row = {**common, **one} if isinstance(one, dict) else {"no object": one}
        rows.append({name.replace("-", "_"): value for name, value in row.items() if value is not None})
    return rows


def _job_of_row(row: Mapping[str, Any], folder: Path, names: _Names) -> tuple[Job | None, list[str]]:
    """Return the job of a row, None where it is not clear which one, and what is wrong with the row."""
    if "no object" in row:
        return None, [f"it is {one_line(row['no object'], 40)!r}; give an object with scan and photo, or survey"]
    if "too many cells" in row:
        return None, [f"it has {row['too many cells']} cells, more than the header"]
    faults, options = [], {}
    for name, value in row.items():
        if name in _OWN:
            continue
        try:
            options[name] = parsed_option(name, value, folder)
        except OptionError as error:
            faults.append(str(error))
    paths = {name: _paths(row.get(name), folder) for name in ("scan", "photo", "photos", "more", "survey")}
    wrong = [name for name, found in paths.items() if found is None]
    several = [name for name in ("scan", "photo", "survey") if len(paths[name] or ()) > 1]
    if wrong or several:
        return None, [*faults, f"{', '.join(wrong or several)} must name {'files' if wrong else 'one file'}"]
    scan, photo, photos, more, survey = (tuple(paths[name] or ()) for name in paths)
    if bool(survey) == bool(scan) or (photo and photos) or (survey and (photo or photos or more)):
        return None, [*faults, "it must name a scan and a photo, or a scan and photos, or a survey, and nothing else"]
    if scan and not (photo or photos):
        return None, [*faults, "it names a scan and no photo"]
    of = survey or photo or (scan if photos else ())
    name = names.taken(str(row["name"])) if row.get("name") else names.new(of[0])
    job = Job(
        id=name, kind="survey" if survey else "pair" if photo else "photos", scan=scan[0] if scan else None,
        photos=photo or photos, survey=survey[0] if survey else None, more=more, options=options,
    )  # fmt: skip
    return job, faults


def _paths(value: object, folder: Path) -> list[Path] | None:
    """Return the files that a cell names; None: it names none."""
    texts = value.split("|") if isinstance(value, str) else [] if value is None else value
    if not isinstance(texts, list) or not all(isinstance(one, str) and one.strip() for one in texts):
        return None
    return [folder / one.strip() for one in texts]


def _of_folders(sources: Sequence[JobSource]) -> tuple[list[Job], list[str]]:
    names, jobs, faults = _Names(), [], []
    seen: set[str] = set()
    for source in map(str, sources):
        found = [source] if os.path.isdir(source) else sorted(filter(os.path.isdir, glob.glob(source)))
        if not found:
            faults.append(f"{one_line(source, 120)}: there is no such file or folder")
        for folder in map(Path, found):
            real = os.path.realpath(folder)
            if real in seen or (is_batch_folder(folder, JOBS_RUN) and len(found) > 1):  # results of an earlier run
                continue
            seen.add(real)
            try:
                jobs.append(_job_of_folder(folder.absolute(), names))
            except LadarregError as error:
                faults.append(str(error))
    return jobs, faults


def _job_of_folder(folder: Path, names: _Names) -> Job:
    if (folder / _SURVEY_FILE).is_file():
        return Job(id=names.taken(folder.name), kind="survey", survey=folder / _SURVEY_FILE)
    contents = folder_contents(folder)
    missing = "scan" if not contents.scans else "photo" if not contents.photos else ""
    if missing:
        raise OptionError(
            f"{folder} contains no {missing}; each folder is a job with a scan and photos, a pattern such as "
            f"'{folder.name}/*' means the folders in it"
        )
    if len(contents.scans) > 1:
        return Job(id=names.taken(folder.name), kind="survey", survey=folder)
    return Job(id=names.taken(folder.name), kind="photos", scan=contents.scans[0], photos=contents.photos)


class _Names:
    """Names of jobs that were not given any: of the folder and the file, each once."""

    def __init__(self) -> None:
        self._counts: dict[str, int] = {}

    def taken(self, name: str) -> str:
        """Note a name that was given, and return it."""
        self._counts.setdefault(name.lower(), 1)
        return name

    def new(self, path: Path) -> str:
        """Return a name for the job of a file."""
        stem = path.parent.name if path.name == _SURVEY_FILE else f"{path.parent.name}-{path.stem}"
        name = _NOT_IN_NAMES.sub("-", stem).strip("-.")[:100] or "job"
        number = self._counts[name.lower()] = self._counts.get(name.lower(), 0) + 1
        return name if number == 1 else self.new(path.with_name(f"{path.stem}-{number}{path.suffix}"))
