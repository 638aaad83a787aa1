"""A disk that is full in the middle of a record, on a real server."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from testing.attacks.filled_disks import LimitedDisk, full_disk

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="no limit of file sizes can be set from outside")


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "ends"), [(2, "stop"), pytest.param(1, "torn", marks=pytest.mark.long)])
def test_edits_reported_as_saved_survive_a_truncated_record(tmp_path: Path, seed: int, ends: str) -> None:
    (tmp_path / "disk").mkdir()
    found = full_disk(tmp_path / "room", LimitedDisk(tmp_path / "disk"), seed=seed, ends=ends)
    assert found.lost == []
    assert found.saved >= 3
    assert found.unsaved >= 1
