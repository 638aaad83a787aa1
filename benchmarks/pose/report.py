"""Reports of benchmarks as text, Markdown and JSON: figures with the bars that they have to meet."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from platform import python_version
from textwrap import fill
from typing import Any

import numpy as np

from ladarreg_core.export.comparison.table import Table, markdown_table

LIBRARIES = ("numpy", "scipy", "opencv-python-headless", "poselib")
NOTHING = "-"
_PAGE_WIDTH = 115
_BEGIN, _END = "<!-- pose: written by `python -m benchmarks.pose --page` -->", "<!-- pose: end -->"
_SECTION, _CLOSED = "<!-- section: ", " -->"


@dataclass(frozen=True)
class Bar:
    """A figure with its required limits."""

    name: str
    value: float
    least: float | None = None
    most: float | None = None
    error: float | None = None
    """Standard error of the value, where it is comparable to the margin."""
    digits: int = 2

    @property
    def met(self) -> bool:
        """Whether the limits are met; an unknown figure meets none."""
        return bool(
            not math.isnan(self.value)
            and (self.least is None or self.value >= self.least)
            and (self.most is None or self.value <= self.most)
        )

    @property
    def verdict(self) -> str:
        return "met" if self.met else "MISSED"

    def cells(self) -> tuple[str, str, str, str]:
        value = number(self.value, self.digits)
        if self.error is not None and math.isfinite(self.error):
            value += f" ± {number(self.error, self.digits)}"
        least, most = (None if bound is None else f"{bound:,g}" for bound in (self.least, self.most))
        held = f"{least} to {most}" if least and most else f">= {least}" if least else f"<= {most}"
        return self.name, value, held, self.verdict


@dataclass(frozen=True)
class Section:
    """A section of a report."""

    key: str
    """Key in the JSON."""
    title: str
    note: str
    """How to read the tables."""
    tables: tuple[tuple[str, Table], ...]
    """Tables with their captions, which may be empty."""
    bars: tuple[Bar, ...] = ()
    figures: Mapping[str, Any] = field(default_factory=dict)
    """The numbers behind the tables."""


def number(value: float, digits: int = 2) -> str:
    """Format a number as a cell; a dash where unknown."""
    if math.isnan(value):
        return NOTHING
    return f"{value:,.{digits}f}" if math.isfinite(value) else "no pose"


def percent(share: float, digits: int = 1) -> str:
    """Format a share as a cell."""
    return NOTHING if math.isnan(share) else f"{100 * share:.{digits}f} %"


def table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    """Build a table of cells; each row begins with its name."""
    return Table(heads=tuple(heads), rows=tuple(tuple(row) for row in rows))


def as_text(section: Section) -> str:
    """Format a section for a terminal."""
    lines = [section.title, fill(section.note, _PAGE_WIDTH, initial_indent="  ", subsequent_indent="  ")]
    for caption, of_cells in section.tables:
        lines += [f"  {caption}"] if caption else []
        lines += _aligned(("", *of_cells.heads), of_cells.rows)
    lines += [f"  {verdict:6}  {name}: {value} (held to {held})" for name, value, held, verdict in _bar_rows(section)]
    return "\n".join(lines) + "\n"


def _aligned(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(len(row[k]) for row in (heads, *rows)) for k in range(len(heads))]
    return [
        "    "
        + "  ".join(cell.rjust(w) if k else cell.ljust(w) for k, (cell, w) in enumerate(zip(row, widths, strict=True)))
        for row in (heads, *rows)
    ]


def _bar_rows(section: Section) -> list[tuple[str, str, str, str]]:
    return [bar.cells() for bar in section.bars]


def as_markdown(section: Section, *, seeds: Sequence[int]) -> str:
    """Format a section for a page."""
    parts = [f"### {section.title}\n", f"{fill(section.note, _PAGE_WIDTH)}\n"]
    for caption, of_cells in section.tables:
        parts += [f"{caption}\n"] if caption else []
        parts.append(markdown_table(of_cells))
    if section.bars:
        parts.append(markdown_table(table(("figure", "held to", ""), _bar_rows(section))))
    ran = ", ".join(f"{name} {of}" for name, of in versions().items())
    parts.append(f"{len(seeds)} seeds ({seeds[0]} to {seeds[-1]}), one core; {ran}.\n")
    return "\n".join(parts)


def as_json(sections: Sequence[Section], *, seeds: Sequence[int]) -> dict[str, Any]:
    """Return every figure with the seeds and the software; unknown ones are null."""
    return {
        "seeds": list(seeds),
        "versions": versions(),
        "sections": {section.key: _plain(dict(section.figures)) for section in sections},
        "bars": [_plain(asdict(bar)) | {"verdict": bar.verdict} for section in sections for bar in section.bars],
    }


def versions() -> dict[str, str]:
    """Return the versions of Python and of the relevant libraries that are installed."""
    found = {"python": python_version()}
    for name in LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [_plain(item) for item in value]
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, int | float | np.number):
        finite = math.isfinite(value)
        return (int(value) if isinstance(value, int | np.integer) else float(value)) if finite else None
    return value


def write_json(path: Path, sections: Sequence[Section], *, seeds: Sequence[int]) -> None:
    """Write `as_json` to a file."""
    path.write_text(json.dumps(as_json(sections, seeds=seeds), indent=1, allow_nan=False) + "\n", encoding="utf-8")


def write_page(path: Path, sections: Sequence[Section], *, seeds: Sequence[int]) -> None:
    """Replace sections between the two markers of a page; everything else stays.

    A page without markers gets them at its end.
    """
    page = path.read_text(encoding="utf-8") if path.exists() else "# Benchmarks\n"
    before, begin, rest = page.partition(_BEGIN)
    inside, end, after = rest.partition(_END)
    if not (begin and end):
        before, inside, after = page.rstrip("\n") + "\n\n", "", "\n"
    of_key: dict[str, str] = {}
    for block in inside.split(_SECTION)[1:]:
        key, _, words = block.partition(_CLOSED)
        of_key[key] = words.strip("\n")
    for section in sections:
        of_key[section.key] = as_markdown(section, seeds=seeds).strip("\n")
    blocks = [f"{_SECTION}{key}{_CLOSED}\n{words}\n" for key, words in of_key.items()]
    path.write_text("\n".join([f"{before}{_BEGIN}", *blocks, f"{_END}{after}"]), encoding="utf-8")


def first_third(seeds: Sequence[int]) -> Sequence[int]:
    """Return the seeds for a slow method: a third of the cases of the others."""
    return seeds[: max(2, len(seeds) // 3)]
