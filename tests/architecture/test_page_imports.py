"""The page's modules: every import exists, rooms import one way only, and no file takes part in a circle."""

from __future__ import annotations

import re
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

PAGE = Path(__file__).resolve().parents[2] / "static" / "js"
PANELS = {
    f"panels/{room}" for room in ("acquire", "export", "files", "matches", "model", "pose", "project", "stations")
}
ROOMS: dict[str, set[str]] = {
    "ui": set(),
    "net": {"ui"},
    "state": {"ui", "net"},
    "panes": {"ui", "net", "state"},
    **{
        f"panels/{room}": {"ui", "net", "state"}
        for room in ("acquire", "export", "files", "matches", "model", "stations")
    },
    "panels/pose": {"ui", "net", "state", "panels/files", "panels/matches"},
    "panels/project": {"ui", "net", "state", "panels/files", "panels/pose"},
    "layout": {"ui", "net", "state", *PANELS},
    "": {"ui", "net", "state", "panes", "layout", *PANELS},
}
"""What each room may import; main.js, at the top, puts everything together."""
LONGEST = 485

_IMPORT = re.compile(r"""^(?:import|export)\s(?:[^;]*?\sfrom\s)?["']([^"']+)["']|\bimport\(["']([^"']+)["']\)""", re.M)
_NAMES = re.compile(r"^import \{([^}]*)\} from [\"']([^\"']+)[\"']", re.M)
_EXPORT = re.compile(r"^export (?:async )?(?:const|class|function|let) (\w+)", re.M)


def without_comments(text: str) -> str:
    """Return the source without its comments: JSDoc names types by import()."""
    return re.sub(r"/\*.*?\*/", "", text, flags=re.S)


@cache
def graph() -> dict[Path, set[Path]]:
    """Return which files each module of the page imports."""
    found = {}
    for path in sorted(PAGE.rglob("*.js")):
        names = [a or b for a, b in _IMPORT.findall(without_comments(path.read_text(encoding="utf-8")))]
        assert all(name.startswith(".") for name in names), f"{path}: the page imports nothing but its own files"
        found[path] = {(path.parent / name).resolve() for name in names}
    return found


def name_of(path: Path) -> str:
    return path.relative_to(PAGE).as_posix()


def room_of(path: Path) -> str:
    return path.relative_to(PAGE).parent.as_posix().replace(".", "")


def test_the_graph_is_read() -> None:
    assert {room_of(path) for path in graph()} == set(ROOMS)
    assert sum(map(len, graph().values())) > 100


def test_every_import_exists_with_the_names_it_asks_for() -> None:
    missing = [
        f"{name_of(path)} imports {other}"
        for path, others in graph().items()
        for other in others
        if not other.is_file()
    ]
    assert not missing
    for path in graph():
        for names, source in _NAMES.findall(without_comments(path.read_text(encoding="utf-8"))):
            exported = set(_EXPORT.findall((path.parent / source).read_text(encoding="utf-8")))
            wanted = {name.split(" as ")[0].strip() for name in names.split(",") if name.strip()}
            assert wanted <= exported, f"{name_of(path)}: {source} does not export {sorted(wanted - exported)}"


def test_every_module_is_reached_from_those_of_the_page() -> None:
    reached: set[Path] = set()
    left = [PAGE / "early.js", PAGE / "main.js"]
    while left:
        path = left.pop()
        if path not in reached:
            reached.add(path)
            left.extend(graph()[path])
    assert set(graph()) - reached == {PAGE / "first_paint.js"}, "a module that is never imported"


@pytest.mark.parametrize("room", sorted(ROOMS))
def test_rooms_import_one_way_only(room: str) -> None:
    wrong = [
        f"{name_of(path)} imports {name_of(other)}"
        for path, others in graph().items()
        for other in others
        if room_of(path) == room and room_of(other) not in ROOMS[room] | {room}
    ]
    assert not wrong


def test_no_files_import_each_other_in_a_circle() -> None:
    try:
        tuple(TopologicalSorter(graph()).static_order())
    except CycleError as error:
        pytest.fail(f"imports in a circle: {' -> '.join(map(name_of, error.args[1]))}")


@pytest.mark.parametrize("path", sorted(PAGE.rglob("*.js")), ids=name_of)
def test_no_file_is_too_long(path: Path) -> None:
    assert len(path.read_text(encoding="utf-8").splitlines()) <= LONGEST
