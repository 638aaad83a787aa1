"""What a target of `ladarreg export` is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

from ladarreg_core.export.registered_scan import RegisteredScan
from ladarreg_core.export.targets.folder import FileJob
from ladarreg_core.foundations.validation import require_choice, require_type
from ladarreg_core.progress import Report

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
    """A format or set of files that another program reads."""

    name: str
    """Its name in `--to`, and of the folder that it writes."""
    title: str
    """Its name for people."""
    purpose: str
    """A sentence: what it contains and which programs read it."""
    files: Callable[[RegisteredScan, ExportOptions, Report | None], Sequence[FileJob]]
    """Returns the names, relative to its folder and with `/`, and writers of its files.

    A writer of a large file reports its progress (`Progress`) at least every second; the report may raise `Cancelled`.
    """
    shows_refused: bool = False
    """Whether it may show poses that were refused."""
    refusal: Callable[[RegisteredScan, ExportOptions], str | None] = lambda handed, options: None
    """Returns a sentence (found, needed, what to do) if it cannot be written, before anything is; None otherwise."""
