"""Where a scan or a photograph was read from, so that results can state it."""

from __future__ import annotations

import copy
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Source:
    """Files and the options that they were read with."""

    files: tuple[Path, ...]
    """The files, its own first; absolute."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Arguments of the reader."""


def with_source(value: T, files: Sequence[str | os.PathLike[str]], options: Mapping[str, Any]) -> T:
    """Return a copy of a scan or a photograph, its arrays shared, that states where it was read from."""
    found = copy.copy(value)
    object.__setattr__(found, "source", Source(tuple(Path(os.path.abspath(file)) for file in files), dict(options)))
    return found
