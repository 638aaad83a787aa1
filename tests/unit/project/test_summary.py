"""Summaries of projects: what a list says of a folder, whatever its state."""

from __future__ import annotations

from pathlib import Path

import pytest

from ladarreg_core.errors import FormatError
from ladarreg_core.project.summary import ProjectSummary, read_summary

SAVED = Path(__file__).parents[2] / "app/workbench/saved_by_0_1/project"


def summary(*, scan: str | None, photos: int, solved: int, accepted: int) -> str:
    return ProjectSummary("x", scan, photos, solved, accepted, "").describe()


def test_a_project_of_an_earlier_version_is_summarised() -> None:
    found = read_summary(SAVED)
    assert (found.name, found.scan, found.photos) == ("Desk by the window", "desk.npz", 1)
    assert found.solved == 1


def test_states_are_told_in_words() -> None:
    assert summary(scan=None, photos=0, solved=0, accepted=0) == "empty"
    assert summary(scan="a", photos=0, solved=0, accepted=0) == "no photograph yet"
    assert summary(scan=None, photos=2, solved=0, accepted=0) == "no scan yet"
    assert summary(scan="a", photos=2, solved=0, accepted=0) == "2 photographs, not solved"
    assert summary(scan="a", photos=1, solved=1, accepted=0) == "solved, not accepted"
    assert summary(scan="a", photos=1, solved=1, accepted=1) == "accepted"
    assert summary(scan="a", photos=3, solved=3, accepted=2) == "2 of 3 photographs accepted"


@pytest.mark.parametrize("data", [b"", b"[]", b"\xff", b'{"photos": 3}', b'{"photos": [{"poses": {}}]}'])
def test_a_damaged_file_is_an_error_that_names_no_path(tmp_path: Path, data: bytes) -> None:
    folder = tmp_path / "office"
    folder.mkdir()
    (folder / "project.json").write_bytes(data)
    with pytest.raises(FormatError, match="office is damaged") as raised:
        read_summary(folder)
    assert str(tmp_path) not in str(raised.value)
    with pytest.raises(FormatError, match="cannot be read"):
        read_summary(tmp_path / "nothing")
