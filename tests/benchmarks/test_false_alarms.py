"""The count of accepted wrong pairs: its bound, and that a stopped run goes on."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import false_alarms
from benchmarks.false_alarms import most_probable_rate, tried_pairs
from ladarreg_core.frames import Rigid


@dataclass(frozen=True)
class Case:
    scan: str
    photo: str
    camera_from_scanner: Rigid


def test_the_bound_is_that_of_the_binomial_distribution() -> None:
    assert most_probable_rate(0, 3000) == pytest.approx(1 - 0.05 ** (1 / 3000), rel=1e-6)
    assert most_probable_rate(1, 3000) > most_probable_rate(0, 3000)
    rate = most_probable_rate(2, 50)
    chance = sum((1 - rate) ** (50 - k) * rate**k * c for k, c in ((0, 1), (1, 50), (2, 1225)))
    assert chance == pytest.approx(0.05, rel=1e-6)
    assert most_probable_rate(0, 0) == 1.0


def test_a_stopped_run_goes_on_and_no_picture_is_used_twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    registered: list[tuple[str, str]] = []

    def simulate(scene: str, *, lidar: str, seed: int) -> Case:
        return Case(f"{scene} {lidar} {seed}", f"{scene} {lidar} {seed}", Rigid.identity())

    def register(scan: str, photo: str, *, initial: Any) -> Any:
        if len(registered) == 7:
            raise KeyboardInterrupt
        registered.append((scan, photo))
        return type("Result", (), {"accepted": len(registered) == 3})

    monkeypatch.setattr(false_alarms, "simulate_outdoors", simulate)
    monkeypatch.setattr(false_alarms.lr, "register", register)
    journal = tmp_path / "journal"
    with pytest.raises(KeyboardInterrupt):
        tried_pairs(journal, range(2), until=np.inf)
    assert len(journal.read_text().splitlines()) == 7
    with journal.open("a") as file:
        file.write('{"pair": "cut')
    registered.append(("", ""))  # the interrupt is over
    file_before = journal.read_text()
    found = tried_pairs(journal, range(2), until=np.inf)
    assert journal.read_text().startswith(file_before)
    assert len(found) == 24
    assert sum(found) == 1
    pairs = [pair for pair in registered if pair[0]]
    assert len(pairs) == len(set(pairs)) == 24
    assert all(scan != photo for scan, photo in pairs)
    assert len({photo for _, photo in pairs}) == 24
    assert tried_pairs(journal, range(9), until=0) == found
    whole = [json.loads(line) for line in journal.read_text().splitlines() if line.endswith("}")]
    assert {one["guess"] for one in whole} == {True, False}
