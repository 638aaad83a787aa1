"""Which files of a batch belong together, and in which order they are opened."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import PurePosixPath

from ladarreg_core.formats.survey import FileSurvey

_ORDER = ("scan", "photo", "camera", "matches")
_WORDS = frozenset(
    ("cam", "camera", "calib", "calibration", "intrinsic", "intrinsics", "info", "match", "matches", "line", "lines")
)
"""Words in the names of cameras and matches that do not say which photograph they belong to."""
_MAX_NAMED = 3


@dataclass(frozen=True, slots=True)
class BatchFile:
    """A file that is not opened yet."""

    id: str
    """Random; the stem of its name on disk."""
    name: str
    """Name that the operator knows it by."""
    size: int
    """Size, bytes."""
    survey: FileSurvey
    """What its content says."""


@dataclass(frozen=True, slots=True)
class PhotoTarget:
    """A photograph that a camera or matches may belong to."""

    id: str
    """Its id in the project, or that of its file in the batch."""
    name: str
    """File name."""
    width: int
    """Pixels; 0 where unknown."""
    height: int
    """Pixels; 0 where unknown."""


@dataclass(frozen=True, slots=True)
class Step:
    """The opening of one file."""

    file: BatchFile
    """The file."""
    companions: Mapping[str, BatchFile] = field(default_factory=dict)
    """Files that it names, by the path under which it names them."""
    photos: tuple[str, ...] = ()
    """Ids of the photographs that it belongs to, as in `PhotoTarget`."""


@dataclass(frozen=True, slots=True)
class Reason:
    """Why a file waits."""

    said: str
    """What is missing or ambiguous, and what to do."""
    needs_choice: bool = False
    """Whether the operator has to choose; otherwise further files may settle it."""
    part_of: str = ""
    """Id of the file that names this one; empty: none."""
    is_underspecified: bool = False
    """Whether it is a scan that can be opened once the operator says what its file does not."""


@dataclass(frozen=True, slots=True)
class Plan:
    """What is opened, in this order, and what has to wait."""

    steps: tuple[Step, ...]
    """Files to open; scans first, which are opened together, or one of them."""
    waiting: Mapping[str, Reason]
    """The other files, by id."""


def plan_batch(
    files: Sequence[BatchFile],
    photos: Sequence[PhotoTarget],
    *,
    shown: str | None,
    has_scan: bool,
    photo: str | None = None,
) -> Plan:
    """Plan a batch; the order of its files does not matter.

    Args:
        files: the files.
        photos: photographs of the project.
        shown: id of the one that the operator sees.
        has_scan: whether the project has a scan.
        photo: id of the photograph that the operator chose for cameras and matches; None: none.
    """
    waiting: dict[str, Reason] = {}
    scans, used = _scans(files, waiting)
    scans.sort(key=lambda step: _in_order(step.file.name))
    rest = [file for file in files if file.id not in used and file.survey.kind != "scan"]
    new = [file for file in rest if file.survey.kind == "photo"]
    targets = [PhotoTarget(f.id, f.name, f.survey.width, f.survey.height) for f in new]
    steps = [*scans, *(Step(file) for file in new)]
    for file in sorted(rest, key=lambda each: (each.survey.kind, each.name)):
        kind = file.survey.kind
        if kind == "photo":
            continue
        if kind not in _ORDER:
            said = f"it is a {kind} file, which the workbench does not open: remove it"
            waiting[file.id] = Reason(said, needs_choice=True)
        elif kind == "matches" and not (has_scan or scans):
            waiting[file.id] = Reason("matches need a scan: drop the scan as well")
        elif photo is not None:
            steps.append(Step(file, photos=(photo,)))
        else:
            found = _targets_of(file, targets or photos, None if targets else shown)
            if isinstance(found, Reason):
                waiting[file.id] = found
            else:
                steps.append(Step(file, photos=found))
    return Plan(_without_rivals(steps, waiting), waiting)


def _scans(files: Sequence[BatchFile], waiting: dict[str, Reason]) -> tuple[list[Step], set[str]]:
    """Return the scans that are complete, and the ids of all files that belong to a scan."""
    steps: list[Step] = []
    used: set[str] = set()
    for file in (file for file in files if file.survey.kind == "scan"):
        others = [other for other in files if other.id != file.id]
        found = {name: _named(name, others) for name in file.survey.names}
        there = {name: other for name, other in found.items() if other is not None}
        used |= {other.id for other in there.values()}
        if missing := [name for name, other in found.items() if other is None]:
            it = "it" if len(missing) == 1 else "them"
            was = "was" if len(missing) == 1 else "were"
            waiting[file.id] = Reason(
                f"the descriptor names {listed(missing)}, which {was} not among the files: drop {it} as well"
            )
            waiting |= _companions_wait(file, there)
        else:
            steps.append(Step(file, there))
    return steps, used


def _companions_wait(file: BatchFile, companions: Mapping[str, BatchFile]) -> dict[str, Reason]:
    """Return the reasons of files that are opened with the one that names them."""
    part = Reason(f"it is part of {file.name}", needs_choice=True, part_of=file.id)
    return {other.id: part for other in companions.values()}


def _named(path: str, files: Sequence[BatchFile]) -> BatchFile | None:
    """Return the file that a descriptor means: of the same name, or the only one with the same stem."""
    name = PurePosixPath(path).name.casefold()
    same = [file for file in files if file.name.casefold() == name]
    stem = PurePosixPath(name).stem
    alike = same or [
        file for file in files if file.survey.kind == "photo" and PurePosixPath(file.name.casefold()).stem == stem
    ]
    return alike[0] if len(alike) == 1 or same else None


def _targets_of(file: BatchFile, photos: Sequence[PhotoTarget], shown: str | None) -> tuple[str, ...] | Reason:
    """Return the photographs that a camera or matches belong to, or a reason if that is not clear."""
    if not photos:
        kind = "a camera belongs" if file.survey.kind == "camera" else "matches belong"
        return Reason(f"{kind} to a photograph: drop the photograph as well")
    if len(photos) == 1:
        return (photos[0].id,)
    words = _words(file.name)
    named = [photo for photo in photos if words and _words(photo.name) == words]
    if len(named) == 1:
        return (named[0].id,)
    if taken := [photo for photo in photos if _is_listed(photo.name, file.survey.pictures)]:
        return tuple(photo.id for photo in taken)
    sizes = [{*size} for size in file.survey.sizes or ((file.survey.width, file.survey.height),)]
    fits = [photo for photo in photos if 0 not in sizes[0] and {photo.width, photo.height} in sizes]
    if file.survey.kind == "camera" and fits and (shown is None or len(fits) == 1):
        return tuple(photo.id for photo in fits)  # one calibration serves all pictures of its camera
    if shown is not None and (not fits or any(photo.id == shown for photo in fits)):
        return (shown,)
    names = listed([photo.name for photo in fits or photos], "or")
    return Reason(f"it could belong to {names}: choose the photograph", needs_choice=True)


def _is_listed(photo: str, pictures: Sequence[str]) -> bool:
    """Return whether a camera file lists a photograph, with or without its folder and ending."""
    name = photo.casefold()
    wanted = {name, PurePosixPath(name).stem}
    return any(PurePosixPath(other.replace("\\", "/").casefold()).name in wanted for other in pictures)


def with_companions(files: Sequence[BatchFile], others: Sequence[BatchFile]) -> list[BatchFile]:
    """Return files, and those of the others that one of them names."""
    there = list(files)
    for file in files:
        there += [found for name in file.survey.names if (found := _named(name, others)) and found not in there]
    return there


def _without_rivals(steps: list[Step], waiting: dict[str, Reason]) -> tuple[Step, ...]:
    """Return the steps without cameras that would replace each other, whose reasons are added; a name decides first."""
    cameras = [step for step in steps if step.file.survey.kind == "camera"]
    single = {step.photos[0] for step in cameras if len(step.photos) == 1}
    kept: list[Step] = []
    for step in steps:
        if step.file.survey.kind != "camera":
            kept.append(step)
            continue
        photos = step.photos if len(step.photos) == 1 else tuple(p for p in step.photos if p not in single)
        rivals = [
            other.file.name
            for other in cameras
            if other is not step and len(other.photos) == len(step.photos) and set(other.photos) & set(photos)
        ]
        if rivals:
            same = listed([step.file.name, *rivals])
            waiting[step.file.id] = Reason(f"{same} fit the same photograph: open one of them", needs_choice=True)
        elif photos:
            kept.append(Step(step.file, photos=photos))
        else:
            waiting[step.file.id] = Reason(
                "every photograph that it fits has a camera file of its own: remove it", needs_choice=True
            )
    return tuple(sorted(kept, key=lambda each: _ORDER.index(each.file.survey.kind)))


def _words(name: str) -> tuple[str, ...]:
    """Return the words of a file name that say which photograph is meant."""
    stem = name.casefold().rpartition(".")[0] or name.casefold()
    return tuple(word for word in re.split(r"[\W_]+", stem) if word and word not in _WORDS)


def _in_order(name: str) -> list[tuple[int, str]]:
    """Return a key by which names are sorted as people number them: 2.pcd before 10.pcd."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name.casefold())]


def listed(names: Sequence[str], joined: str = "and") -> str:
    """Return names as a phrase, at most a few of them."""
    shown = list(names[:_MAX_NAMED])
    if len(names) > _MAX_NAMED:
        shown.append(f"{len(names) - _MAX_NAMED} more")
    return f" {joined} ".join([", ".join(shown[:-1]), shown[-1]] if len(shown) > 1 else shown)
