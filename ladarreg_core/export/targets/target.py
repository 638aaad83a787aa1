"""What a target of an export is: anything that is written."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

from ladarreg_core.export.registered_scan import RegisteredScan
from ladarreg_core.export.targets.folder import FileJob
from ladarreg_core.foundations.progress import Report
from ladarreg_core.foundations.validation import require_choice, require_type

Crop = Literal["none", "photo"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportOptions:
    """Options of the targets; each uses those that concern it.

    Raises:
        OptionError: if a value is not of its type or choice.
    """

    full: bool = False
    """Write whole meshes instead of those reduced by error."""
    crop: Crop = "none"
    """`photo` leaves out of models what no photograph covers."""

    def __post_init__(self) -> None:
        require_type(self.full, bool, "full")
        require_choice(self.crop, get_args(Crop), "crop")


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """A format or set of files, for people or for another program."""

    name: str
    """Its name in `--to`, and of the folder that it writes."""
    title: str
    """Its name for people."""
    purpose: str
    """A sentence: what it contains and which programs read it."""
    files: Callable[[Any, ExportOptions, Report | None], Sequence[FileJob]]
    """Returns the names, relative to its folder and with `/`, and writers of its files, given a source of `reads`.

    A writer of a large file reports its progress (`Progress`) at least every second; the report may raise `Cancelled`.
    """
    reads: tuple[type, ...] = (RegisteredScan,)
    """The sources that it is written from; a file for each of those that there are. Of a survey that is none of them,
    it is written for every scan in a folder of its own."""
    needs: str = "a registered photograph"
    """What there has to be, for messages."""
    stands_alone: bool = False
    """Whether its files, written without those of other targets, need no folder and no `export.json` beside them."""
    shows_refused: bool = False
    """Whether it may show poses that were refused."""
    shows_drawn: bool = False
    """Whether it writes the matches of photographs without a pose."""
    together: bool = False
    """Whether two of its files may be written at a time if the scan is not large."""
    without_photos: bool = False
    """Whether it is written, too, for a scan of a survey that no photograph is registered on."""
    refusal: Callable[[Any, ExportOptions], str | None] = lambda source, options: None
    """Returns a sentence (found, needed, what to do) if it cannot be written, before anything is; None otherwise."""
