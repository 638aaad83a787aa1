"""Files that change as one: whatever fails, wherever the program ends, a folder holds the old ones or the new ones."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from ladarreg_core.errors import ExportError, FormatError
from ladarreg_core.storage.manifest import MANIFEST_FILE, read_manifest, write_manifest
from ladarreg_core.storage.moved_together import MOVES_FILE, finish_moves, is_unfinished, replace_together

NAMES = ("a.json", "b.png")
MOVES = 6  # both files and the manifest, away and into


class Killed(BaseException):
    """The program ends here."""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    home = tmp_path / "home"
    home.mkdir()
    for name in NAMES:
        (home / name).write_text("old")
    write_manifest(home)
    return home


def written(text: str) -> Callable[[Path], None]:
    return lambda path: path.write_text(text)  # type: ignore[return-value]


def replaced(folder: Path, text: str = "new") -> None:
    replace_together(folder, {name: written(text) for name in NAMES})


def content(folder: Path) -> str:
    """The generation of all files, which the manifest lists as they are; nothing else is there."""
    assert {path.name for path in folder.iterdir()} == {*NAMES, MANIFEST_FILE}
    assert not any(one.fault(folder) for one in (read_manifest(folder) or {}).values())
    (found,) = {(folder / name).read_text() for name in NAMES}
    return found


def failing(monkeypatch: pytest.MonkeyPatch, number: int, error: BaseException, *, lasting: bool = False) -> None:
    """Let a rename fail, of those that move, counted from 0."""
    rename, calls = os.rename, iter(range(10**6))

    def fails(old: Path, new: Path) -> None:
        place = next(calls)
        if place == number or (lasting and place > number):
            raise error
        rename(old, new)

    monkeypatch.setattr(os, "rename", fails)


def test_all_are_replaced(folder: Path) -> None:
    replaced(folder)
    assert content(folder) == "new"
    replaced(folder)  # the same again: no file can be told from its successor
    assert content(folder) == "new"


@pytest.mark.parametrize("number", range(MOVES))
def test_a_move_that_fails_is_taken_back(folder: Path, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    with monkeypatch.context() as patch:
        failing(patch, number, OSError(5, "Input/output error"))
        with pytest.raises(ExportError, match="input/output error"):
            replaced(folder)
    assert content(folder) == "old"


@pytest.mark.parametrize("text", ["new", "old"])
@pytest.mark.parametrize("number", range(MOVES))
def test_a_program_that_ends_is_followed_by_one_that_finishes(
    folder: Path, monkeypatch: pytest.MonkeyPatch, number: int, text: str
) -> None:
    with monkeypatch.context() as patch:
        failing(patch, number, Killed())
        with pytest.raises(Killed):
            replaced(folder, text)
    assert (folder / MOVES_FILE).exists()
    finish_moves(folder, lock=".lock", what="run")
    assert content(folder) == text


@pytest.mark.parametrize("number", range(MOVES))
def test_a_disk_that_fails_for_good_leaves_the_list(folder: Path, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    with monkeypatch.context() as patch:
        failing(patch, number, OSError(5, "Input/output error"), lasting=True)
        with pytest.raises(ExportError):
            replaced(folder)
        if (folder / MOVES_FILE).exists():
            with pytest.raises(ExportError, match="was interrupted and cannot be finished"):
                finish_moves(folder, lock=".lock", what="run")
    finish_moves(folder, lock=".lock", what="run")
    assert content(folder) == ("old" if number == 0 else "new")


def test_what_is_not_ours_is_not_replaced(folder: Path) -> None:
    (folder / NAMES[0]).write_text("of somebody")
    with pytest.raises(ExportError, match=r"another SHA-256|has 11 bytes"):
        replaced(folder)
    assert (folder / NAMES[0]).read_text() == "of somebody"
    assert {path.name for path in folder.iterdir()} == {*NAMES, MANIFEST_FILE}


def test_a_list_of_somebody_else_moves_nothing_out(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        failing(patch, 1, Killed())
        with pytest.raises(Killed):
            replaced(folder)
    text = (folder / MOVES_FILE).read_text()
    for forged in (text.replace("a.json", "../a.json"), text.replace("a.json", "b.json"), text[:-9], "{}"):
        (folder / MOVES_FILE).write_text(forged)
        with pytest.raises(FormatError, match="is damaged"):
            finish_moves(folder, lock=".lock", what="run")
    assert all(is_unfinished(path.name) or path.name in (*NAMES, MANIFEST_FILE) for path in folder.iterdir())
