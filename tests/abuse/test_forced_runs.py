"""A drawn share of `benchmarks.abuse.hostile`: `--force` beside files of somebody else."""

from __future__ import annotations

import pytest

from testing.attacks.forced_runs import COMMANDS, forced_runs


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_force_loses_no_file_of_somebody_else(command: str) -> None:
    found = forced_runs(command, 3, seed=1)
    assert found.lost == []
    assert found.refused + found.replaced, "the folder was looked at"
