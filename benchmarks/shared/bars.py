"""Figures against their bars, as tables show them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Row:
    """A figure of a benchmark."""

    what: str
    bar: str
    """What is asked for; of a control, what shows that it fails."""
    reached: str
    held: bool


def table(rows: list[Row]) -> str:
    """Return a Markdown table."""
    lines = [f"| {row.what} | {row.bar} | {row.reached} | {_verdict(row)} |" for row in rows]
    return "\n".join(["| what | bar | reached | |", "|---|---|---|---|", *lines])


def _verdict(row: Row) -> str:
    """Return whether a bar was held; nothing where there is none."""
    if row.bar in ("", "reported"):
        return ""
    return "held" if row.held else "MISSED"
