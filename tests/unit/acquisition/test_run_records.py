"""The records of a run: what runs, panoramas and lists of runs read is the same."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from ladarreg_core.acquisition.plan import Axis, Plan, ScannerPlan, UnitPlan
from ladarreg_core.acquisition.runs.piece_list import read_piece_list
from ladarreg_core.acquisition.runs.run_folder import RunFolder, RunWriter, summary
from ladarreg_core.acquisition.simulated.world import LINE_MOUNT
from ladarreg_core.errors import FormatError

GOOD = '{"index": 0, "file": "pieces/000.npz", "read_deg": [1, 2]}'


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    plan = Plan(UnitPlan("x"), ScannerPlan("scip2", "y"), "sweep", Axis(0, 4, 2), Axis(0, 0, 1), LINE_MOUNT)
    RunWriter.begin(tmp_path / "run", plan).close()
    (tmp_path / "run" / "pieces" / "000.npz").write_bytes(b"0")
    return tmp_path / "run"


def test_a_run_that_has_just_begun_has_no_pieces(folder: Path) -> None:
    assert RunFolder.open(folder).records == {}
    assert summary(folder).done == 0
    with pytest.raises(FormatError, match="no piece yet"):
        read_piece_list(folder)


@pytest.mark.parametrize("rest", ["", '\n{"index": 1, "fi', "\n\n"])
def test_a_record_counts_for_all_readers_and_half_a_one_for_none(folder: Path, rest: str) -> None:
    (folder / "run.jsonl").write_text(GOOD + rest)
    run = RunFolder.open(folder)
    assert (set(run.records), run.faults, summary(folder).done) == ({0}, [], 1)
    assert [(piece.index, piece.sha256) for piece in read_piece_list(folder).pieces] == [(0, None)]


@pytest.mark.parametrize(
    "change",
    [
        {"index": -1}, {"index": 1.5}, {"index": True}, {"file": "../x"}, {"file": None}, {"read_deg": [0]},
        {"read_deg": [1e9, 0]}, {"sha256": 4}, {"pass": "first"}, {"photo": "/etc/passwd"}, {"photo": 3},
    ],
)  # fmt: skip
def test_what_is_no_record_counts_for_no_reader(folder: Path, change: dict[str, object]) -> None:
    (folder / "run.jsonl").write_text(json.dumps({**json.loads(GOOD), **change}) + "\n")
    run = RunFolder.open(folder)
    assert run.records == {}
    assert "line 1" in run.faults[0]
    assert summary(folder).done == 0
    with pytest.raises(FormatError, match=r"run\.jsonl: .*line 1"):
        read_piece_list(folder)
