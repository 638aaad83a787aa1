"""The report of `benchmarks.matching`, and its page, which keeps the text around the tables."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from benchmarks.matching.report import sections, write_page
from benchmarks.register import Row


def row(set_name: str, accepted: bool, px: float, *, method: str = "auto", seconds: float = 0.5) -> Row:
    return Row(method, set_name, "boxes", 7, accepted, px, 0.01, 2.0, seconds, sigmas=1.0, steps={"climb": 0.1})


def bars_of(rows: list[Row]) -> dict[str, tuple[float, bool]]:
    return {bar.name: (bar.value, bar.met) for section in sections(rows) for bar in section.bars}


def test_one_lost_case_and_one_wrong_acceptance_are_seen() -> None:
    good = [row("standard", True, 0.1)] * 3
    assert all(met for _, met in bars_of(good).values())
    assert bars_of([*good, row("standard", False, 0.1)])["standard: accepted, %"] == (75.0, False)
    assert bars_of([*good, row("standard", True, 0.7)])["standard: worst px"] == (0.7, False)
    asked = "photograph of another room: accepted and > 2 px off"
    assert bars_of([row("wrong", False, math.inf)])[asked] == (0, True)
    assert bars_of([row("wrong", False, math.inf), row("wrong", True, math.inf)])[asked] == (1, False)
    near = "started 4, 8 and 16 degrees and up to .8 m off, no other help: accepted and > 2 px off"
    assert bars_of([row("near", True, 1.9)])[near] == (0, True)
    assert bars_of([row("near", True, math.nan)])[near] == (1, False)


def test_a_peer_changes_no_bar_of_ours() -> None:
    ours = [row("hard", True, 0.2)]
    assert bars_of(ours) == bars_of([*ours, row("hard", True, 90.0, method="SIFT + RANSAC", seconds=99)])


def test_the_page_keeps_the_text_around_the_tables(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("Before.\n\n<!-- matching: begin -->\nold\n<!-- matching: end -->\n\nAfter.\n", encoding="utf-8")
    write_page(page, [row("standard", True, 0.11)])
    once = page.read_text(encoding="utf-8")
    write_page(page, [row("standard", True, 0.11)])
    assert page.read_text(encoding="utf-8") == once
    assert once.startswith("Before.\n\n<!-- matching: begin -->\n")
    assert once.endswith("<!-- matching: end -->\n\nAfter.\n")
    assert "old" not in once
    assert "0.11" in once
    page.write_text("no markers\n", encoding="utf-8")
    with pytest.raises(SystemExit, match="matching: begin"):
        write_page(page, [row("standard", True, 0.11)])
