"""`Job`: one registration or survey of a batch, with the options that the single command has."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args

from ladarreg_core.errors import LadarregError, OptionError
from ladarreg_core.export.output_frame import FrameName
from ladarreg_core.formats.scans.scan_request import SCAN_OPTIONS, ScanOptions
from ladarreg_core.registration.register import RegisterOptions
from ladarreg_core.registration.stated_options import PRIORS, THESIS_ONLY, check_stated, options_of
from ladarreg_core.storage.replacement import is_file_name

JobKind = Literal["pair", "photos", "survey"]
_YES, _NO = ("yes", "true", "1"), ("no", "false", "0")
_SHOWN = 60


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """One job of a batch: what one call of a command does."""

    id: str
    """Unique in the batch, and name of its folder of results."""
    kind: JobKind = "pair"
    """`pair`: as `register SCAN PHOTO`; `photos`: as `register SCAN PHOTO PHOTO ...`; `survey`: as `adjust SURVEY`."""
    scan: Path | None = None
    """The scan; a survey has none here."""
    photos: tuple[Path, ...] = ()
    """The photograph of a pair; one or more of `photos`."""
    survey: Path | None = None
    """File or folder of a survey."""
    more: tuple[Path, ...] = ()
    """Further scans of the same standpoint, to be accumulated."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Values of options of the command, by their names: `focal_px`, `camera`, `initial`, `seed`, ..."""

    @property
    def scan_options(self) -> dict[str, Any]:
        """The arguments of `read_scan`."""
        stated = {name: self.options[name] for name in SCAN_OPTIONS if self.options.get(name) is not None}
        return {**ScanOptions(**stated).as_arguments(), "more": self.more}

    @property
    def photo_options(self) -> dict[str, Any]:
        """The arguments of `read_photo`."""
        return {name: self.options.get(name) for name in PHOTO_OPTIONS}

    @property
    def register_options(self) -> RegisterOptions:
        """Seed, thresholds and priors of the registration."""
        return options_of(self.options)

    @property
    def own_files(self) -> list[Path]:
        """The files and folders that the job names, in the order in which the command records them."""
        given = [self.options.get(name) for name in FILES]
        camera, others = given[:1], given[1:]
        named = [self.survey, self.scan, *self.photos, *camera, *self.more, *others]
        return [path for path in named if path is not None]

    def faults(self) -> list[str]:
        """Return what is wrong with it, a sentence each, as far as its files need not be opened for that."""
        found = (
            [] if is_file_name(self.id) and "/" not in self.id else [f"its name {self.id!r:.60} is none of a folder"]
        )
        found += self._faults_of_files()
        taken = OPTIONS_OF[self.kind]
        found += [f"{name} is no option of {_WHAT[self.kind]}" for name in self.options if name not in taken]
        if self.kind == "survey":
            return found
        stated = {name: value for name, value in self.options.items() if name in taken}
        method = str(stated.get("method") or "auto")
        for check in (lambda: self.scan_options, lambda: check_stated(stated, method), lambda: self.register_options):
            try:
                check()
            except LadarregError as error:
                found.append(str(error))
        return found

    def _faults_of_files(self) -> list[str]:
        found = []
        if self.kind == "survey":
            found += [] if self.survey is not None else ["it names no survey"]
        else:
            found += [] if self.scan is not None else ["it names no scan"]
            found += [] if self.photos else ["it names no photo"]
            if self.kind == "pair" and len(self.photos) > 1:
                found.append(f"a pair has one photo, and it names {len(self.photos)}")
        missing = [path for path in self.own_files if not (path.is_file() or (path == self.survey and path.is_dir()))]
        return found + [f"{path}: file not found" for path in missing]


def parsed_option(name: str, value: object, folder: Path) -> Any:
    """Return the value of an option of a list, typed.

    Args:
        name: of the option, with `_`.
        value: a text, as in a table, or a value of JSON.
        folder: where the paths in it start.

    Raises:
        OptionError: if there is no such option, or it is not of its type.
    """
    if name not in _PARSERS:
        raise OptionError(f"{name!r:.60} is no column of a list of jobs and no option of register")
    if isinstance(value, list):
        value = ",".join(map(str, value))
    text = ("yes" if value else "no") if isinstance(value, bool) else str(value).strip()
    if name in FILES:
        return folder / text
    try:
        return _PARSERS[name](text)
    except ValueError as error:
        wanted = str(error) if isinstance(error, OptionError) else "a number"
        raise OptionError(f"{name} is {text[:_SHOWN]!r}; it must be {wanted}") from None


class _NotOfTypeError(OptionError, ValueError):
    """Says what a value must be."""


def _positive(text: str) -> float:
    if not 0 < (value := float(text)) < float("inf"):
        raise _NotOfTypeError("a positive number")
    return value


def _not_negative(text: str) -> float:
    if not 0 <= (value := float(text)) < float("inf"):
        raise _NotOfTypeError("a number from 0")
    return value


def _whole(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise _NotOfTypeError("a whole number") from None


def _yes_or_no(text: str) -> bool:
    if text.lower() not in (*_YES, *_NO):
        raise _NotOfTypeError("yes or no")
    return text.lower() in _YES


def _coordinates(text: str) -> tuple[float, ...]:
    numbers = tuple(float(word) for word in text.replace(",", " ").replace("|", " ").split())
    if len(numbers) != 3:
        raise _NotOfTypeError("three coordinates in metres")
    return numbers


def _names(text: str) -> tuple[str, ...]:
    return tuple(one.strip() for one in text.replace("|", ",").split(","))


def _one_of(text: str, *, words: tuple[str, ...]) -> str:
    if text not in words:
        raise _NotOfTypeError(f"one of {', '.join(words)}")
    return text


def _choice(*words: str) -> Callable[[str], Any]:
    return partial(_one_of, words=words)


FILES = ("camera", "matches", "initial")
"""Options that are files."""
PHOTO_OPTIONS = (
    "camera", "camera_name", "focal_px", "focal_mm", "sensor_mm", "camera_model", "temperature_unit",
)  # fmt: skip
"""Options of reading a photograph."""
_PARSERS: Mapping[str, Callable[[str], Any]] = {
    "scan_index": _whole, "origin": _coordinates, "intensity": _choice("auto", "luma"), "columns": _names,
    "topic": str, "seconds": _positive,
    "camera": str, "camera_name": str, "focal_px": _positive, "focal_mm": _positive, "sensor_mm": _positive,
    "camera_model": _choice("pinhole", "equirectangular"), "temperature_unit": _choice("K", "C", "none"),
    "matches": str, "initial": str, "method": _choice("auto", "thesis", "manual"),
    "proposal": _choice("refined", "drawn", "images"), "smooth": _yes_or_no, "frame": _choice(*get_args(FrameName)),
    "intrinsics": _choice("auto", "fixed", "focal", "focal-k1", "focal-k1-centre"),
    **dict.fromkeys(PRIORS, _not_negative), "match_tolerance_m": _positive, "t1": _not_negative, "t2_px": _positive,
    "culling": _choice("two-sided", "one-sided"), "first_pose": _choice("linear", "robust", "linear-only"),
    "residual": _choice("epipolar", "stereo"), "reject_depth_m": _positive, "samples_per_line": _whole,
    "seed": _whole,
}  # fmt: skip
_OF_PHOTOS = (*SCAN_OPTIONS, *PHOTO_OPTIONS, "frame", "intrinsics", *PRIORS, "seed")
OPTIONS_OF: Mapping[JobKind, tuple[str, ...]] = {
    "pair": tuple(_PARSERS), "photos": _OF_PHOTOS, "survey": ("seed",),
}  # fmt: skip
"""The options that each kind of jobs takes."""
_WHAT = {"pair": "a pair", "photos": "several photos of a scan", "survey": "a survey"}
assert {*THESIS_ONLY, *SCAN_OPTIONS} <= {*_PARSERS}
