"""Kills while three clients edit."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from testing.attacks.kill_rounds import KillRound, kill_rounds

pytestmark = pytest.mark.skipif(os.name != "posix", reason="no kill -9 to send")


@pytest.mark.slow
def test_two_kills_lose_no_saved_edit(tmp_path: Path) -> None:
    rounds = list(kill_rounds(tmp_path, 2, seed=1, scan=False))
    assert [text for found in rounds for text in found.lost] == []
    assert len(rounds) == 2
    assert sum(found.answered for found in rounds) > 10


@pytest.mark.long
def test_ten_kills_lose_no_saved_edit(tmp_path: Path) -> None:
    def five(k: int) -> list[KillRound]:
        return list(kill_rounds(tmp_path / str(k), 5, seed=k, scan=k == 0))

    with ThreadPoolExecutor(2) as pool:
        rounds = [found for part in pool.map(five, range(2)) for found in part]
    assert [text for found in rounds for text in found.lost] == []
    assert len(rounds) == 10
    assert sum(found.answered for found in rounds) > 100
