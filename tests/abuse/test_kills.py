"""Kills while three clients edit."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from testing.attacks.kill_rounds import KillRound, kill_rounds

pytestmark = pytest.mark.skipif(os.name != "posix", reason="no kill -9 to send")


@pytest.mark.parametrize("each", [pytest.param(1, marks=pytest.mark.slow), pytest.param(5, marks=pytest.mark.long)])
def test_kills_lose_no_saved_edit(tmp_path: Path, each: int) -> None:
    def some(k: int) -> list[KillRound]:
        return list(kill_rounds(tmp_path / str(k), each, seed=k, scan=k == 0))

    with ThreadPoolExecutor(2) as pool:
        rounds = [found for part in pool.map(some, range(2)) for found in part]
    assert [text for found in rounds for text in found.lost] == []
    assert len(rounds) == 2 * each
    if each > 1:
        assert sum(found.answered for found in rounds) > 100
