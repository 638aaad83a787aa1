"""What an operator says about a scan's file: checked, and kept with the reference to the file."""

from __future__ import annotations

import pytest
from ladarreg.workbench.files.reading import reading_of, with_reading

from ladarreg_core.errors import OptionError
from ladarreg_core.project.source import Source


def test_options_of_the_page_become_those_of_the_reader() -> None:
    asked = {"scan_index": 2, "origin": [1, 2.5, -3], "columns": ["x", "y", "z"], "intensity": "luma"}
    source = with_reading(Source(path="a.ptx", name="a.ptx", size=1), reading_of(asked))
    assert source.scan_options == {
        "scan_index": 2, "origin": (1.0, 2.5, -3.0), "columns": ("x", "y", "z"), "intensity": "luma", "topic": None,
        "seconds": None,
    }  # fmt: skip


def test_nothing_asked_changes_nothing() -> None:
    source = Source(path="a.ptx", name="a.ptx", size=1)
    assert with_reading(source, reading_of(None)) == with_reading(source, reading_of({})) == source


@pytest.mark.parametrize(
    "wrong",
    [3, ["x"], {"memory_bytes": 1}, {"scan_index": -1}, {"scan_index": "1"}, {"scan_index": True}, {"origin": [1, 2]},
     {"origin": "1,2,3"}, {"origin": [1, 2, float("nan")]}, {"columns": "xyz"}, {"seconds": -1}, {"intensity": "red"}],
)  # fmt: skip
def test_wrong_options_are_refused(wrong: object) -> None:
    with pytest.raises(OptionError):
        reading_of(wrong)
