"""A drawn share of `benchmarks.abuse.hostile`: `--force` beside foreign files."""

from __future__ import annotations

import pytest

from testing.attacks.forced_runs import COMMANDS, forced_runs


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_force_loses_no_foreign_file(command: str) -> None:
    found = forced_runs(command, 3, seed=1)
    assert found.lost == []
    assert found.refused + found.replaced, "the folder was looked at"
