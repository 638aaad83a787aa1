"""The guides for contributors name files that exist, and every room."""

from __future__ import annotations

import re
from collections.abc import Collection
from itertools import takewhile
from pathlib import Path

import pytest

from tests.architecture.test_imports import room_graph
from tests.architecture.test_page_imports import ROOMS

CHECKOUT = Path(__file__).resolve().parents[2]
_PATH = re.compile(r"`((?:app|benchmarks|docs|ladarreg_core|static|tests)/[\w./-]*)`")
_LINK = re.compile(r"\]\(([^)#:]+)(?:#[^)]*)?\)")


@pytest.mark.parametrize("name", ["contributing.md", "glossary.md"])
def test_every_path_that_is_named_exists(name: str) -> None:
    text = (CHECKOUT / "docs" / name).read_text(encoding="utf-8")
    paths = [*_PATH.findall(text), *(f"docs/{link}" for link in _LINK.findall(text))]
    assert len(paths) > 20, "the paths were not found"
    assert not [path for path in paths if not (CHECKOUT / path).exists()]


@pytest.mark.slow
def test_the_picture_of_the_rooms_is_complete() -> None:
    picture = (CHECKOUT / "docs" / "contributing.md").read_text(encoding="utf-8").split("```")[1]
    words = set(re.findall(r"[\w/]+", picture))
    core = {room for room in room_graph() if "/" not in room or room.startswith("thesis/")} - {"thesis"}
    app = {path.name for path in (CHECKOUT / "app").iterdir() if (path / "__init__.py").is_file()}
    assert not core - words
    assert not app - words
    assert not {f"js/{room}" for room in ROOMS if room} - words


@pytest.mark.slow
def test_the_picture_of_the_rooms_shows_imports_that_point_down() -> None:
    picture = (CHECKOUT / "docs" / "contributing.md").read_text(encoding="utf-8").split("```")[1]
    lines = picture.split(" ladarreg_core/ ")[1].split("-----")[0].splitlines()[1:]
    graph = room_graph()
    level = {name: k for k, line in enumerate(lines) for name in _leading(line, graph)}
    assert len(level) > 20, "the picture was not read"
    wrong = [
        f"{room} -> {other}"
        for room, others in graph.items()
        for other in others
        if room in level and other in level and level[other] < level[room]
    ]
    assert not wrong


def _leading(text: str, names: Collection[str]) -> list[str]:
    """Return the names at the beginning of a line of the picture."""
    return list(takewhile(names.__contains__, text.split()))
