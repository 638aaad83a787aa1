"""Options for reading a scan: their values are checked, and formats that do not support one refuse it."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from ladarreg_core.errors import OptionError
from ladarreg_core.formats import describe, read_scan
from ladarreg_core.formats.scans.scan_request import ScanRequest
from ladarreg_core.simulate.sample import sample_folder


def test_values_of_wrong_types_are_refused_by_name() -> None:
    for wrong in (
        {"origin": (1.0, 2.0)}, {"origin": (1.0, math.nan, 0.0)}, {"origin": 3}, {"intensity": "red"},
        {"columns": "x,y,z"}, {"columns": (1, 2)}, {"topic": 3}, {"seconds": 0.0}, {"seconds": math.inf},
    ):  # fmt: skip
        with pytest.raises(OptionError, match=next(iter(wrong))):
            ScanRequest(**wrong)  # type: ignore[arg-type]


def test_an_option_without_a_use_is_refused(tmp_path: Path) -> None:
    path = sample_folder() / "scan.npz"
    for option in ({"columns": ("x",)}, {"topic": "/points"}, {"seconds": 2.0}):
        for read in (read_scan, describe):
            with pytest.raises(OptionError, match=f"{next(iter(option))}. is .* not supported for NPZ files"):
                read(path, **option)  # type: ignore[arg-type]


def test_the_defaults_ask_for_nothing() -> None:
    assert ScanRequest().given() == {}
    assert ScanRequest(scan_index=2, origin=(1, 2, 3)).given() == {"scan_index": 2, "origin": (1.0, 2.0, 3.0)}
