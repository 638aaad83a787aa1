"""The report on sparse lidars: what counts as right and as wrong."""

from __future__ import annotations

import math
from pathlib import Path

from benchmarks.matching.report import sections, write_page
from benchmarks.register import Row


def row(set_name: str, what: str, accepted: bool, px: float) -> Row:
    return Row("auto", set_name, what, 3, accepted, px, 0.1, 20.0, 1.0)


def bars_of(rows: list[Row]) -> dict[str, tuple[float, bool]]:
    return {bar.name: (bar.value, bar.met) for section in sections(rows) for bar in section.bars}


def test_right_is_accepted_and_near_and_wrong_is_accepted_and_far() -> None:
    rows = [row("petals", "street, rough guess", True, 1.0), row("petals", "street, rough guess", False, 1.0)]
    assert bars_of(rows) == {"petals, rough guess: right, %": (50.0, False), "accepted and wrong": (0, True)}
    assert bars_of([*rows, row("petals", "street, no guess", True, 6.1)])["accepted and wrong"] == (1, False)
    assert bars_of([row("petals", "street, no guess", True, math.inf)])["accepted and wrong"] == (1, False)


def test_a_shuffled_pair_must_not_be_accepted() -> None:
    asked = "photo of another place: accepted"
    assert bars_of([row("sparse shuffled", "petals, street, no guess", False, math.inf)]) == {asked: (0, True)}
    assert bars_of([row("sparse shuffled", "petals, street, no guess", True, math.inf)]) == {asked: (1, False)}


def test_real_captures_have_limits_of_their_own() -> None:
    asked = "real: accepted and wrong"
    assert bars_of([row("sparse real", "street, no guess", True, 11.9)]) == {asked: (0, True)}
    assert bars_of([row("sparse real", "garage, no guess", True, 11.9)]) == {asked: (1, False)}


def test_a_page_takes_either_kind_of_sets_and_keeps_the_other(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    markers = "".join(f"<!-- {name}: begin -->\nold {name}\n<!-- {name}: end -->\n" for name in ("matching", "sparse"))
    page.write_text(markers, encoding="utf-8")
    write_page(page, [row("petals", "street, no guess", True, 1.0)])
    text = page.read_text(encoding="utf-8")
    assert "old matching" in text
    assert "old sparse" not in text
    assert "petals, no guess" in text


def test_the_peers_have_a_place_of_their_own_on_a_page(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    names = ("sparse", "sparse peers")
    page.write_text("".join(f"<!-- {n}: begin -->\nold {n}\n<!-- {n}: end -->\n" for n in names), encoding="utf-8")
    write_page(page, [row("sparse peers", "petals, street", True, 1.0)])
    text = page.read_text(encoding="utf-8")
    assert "old sparse\n" in text
    assert "old sparse peers" not in text
    assert "1 of 1" in text
