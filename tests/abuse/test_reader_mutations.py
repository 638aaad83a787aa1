"""Damaged copies of valid files of every format, read in child processes."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

from ladarreg_core.formats import FORMATS
from testing.attacks.mutations import LARGEST, mutated
from testing.attacks.reader_fuzz import read_damaged
from testing.files.seed_files import Seed, write_seeds

_FEW, _MANY = 10, 50


@pytest.fixture(scope="module")
def seeds(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Seed]]:
    folder = tmp_path_factory.mktemp("seeds")
    return folder, write_seeds(folder)


@pytest.mark.parametrize("name", [known.name for known in FORMATS])
@pytest.mark.parametrize(
    "count", [pytest.param(_FEW, marks=pytest.mark.slow), pytest.param(_MANY, marks=pytest.mark.long)]
)
def test_damaged_files_only_cause_errors(seeds: tuple[Path, list[Seed]], name: str, count: int) -> None:
    folder, known = seeds
    if name == "E57" and importlib.util.find_spec("pye57") is None:
        pytest.skip("pye57 is not installed")
    if name == "ROS bag" and importlib.util.find_spec("rosbags") is None:
        pytest.skip("rosbags is not installed")
    assert any(seed.format == name for seed in known), f"add seed_files(folder) to the tests of {name}"
    found = read_damaged(folder, name, 0, count)
    assert found.faults == []
    assert found.files == count
    assert found.refused > 0
    assert count == _FEW or found.refused < count, "some are refused, and some are so little damaged that they are read"


def test_the_same_seed_gives_the_same_damage(seeds: tuple[Path, list[Seed]]) -> None:
    for seed in seeds[1]:
        data = seed.damaged.read_bytes()
        copies = [mutated(data, seed=str(k)) for k in range(20)]
        assert copies == [mutated(data, seed=str(k)) for k in range(20)]
        assert len(set(copies)) > 10
        assert max(map(len, copies)) <= LARGEST
