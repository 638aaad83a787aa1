"""Damaged copies of valid files of every format, read in child processes."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

from ladarreg_core.formats import FORMATS
from testing.attacks.mutations import LARGEST, mutated
from testing.attacks.reader_fuzz import read_damaged, read_damaged_formats
from testing.files.seed_files import Seed, write_seeds

_FEW, _MANY = 10, 50


@pytest.fixture(scope="session")
def seeds(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Seed]]:
    folder = tmp_path_factory.mktemp("seeds")
    return folder, write_seeds(folder)


def is_installed(name: str) -> bool:
    package = {"E57": "pye57", "ROS bag": "rosbags"}.get(name)
    return package is None or importlib.util.find_spec(package) is not None


@pytest.mark.slow
def test_damaged_files_only_cause_errors(seeds: tuple[Path, list[Seed]]) -> None:
    folder, known = seeds
    names = [known.name for known in FORMATS if is_installed(known.name)]
    for name in names:
        assert any(seed.format == name for seed in known), f"add seed_files(folder) to the tests of {name}"
    readings = read_damaged_formats(folder, names, _FEW)
    assert [(found.format, found.files, found.faults) for found in readings] == [(name, _FEW, []) for name in names]
    assert all(found.refused for found in readings)
    assert sum(found.refused for found in readings) < _FEW * len(names), "some are so little damaged that they are read"


@pytest.mark.long
@pytest.mark.parametrize("name", [known.name for known in FORMATS])
def test_many_damaged_files_only_cause_errors(seeds: tuple[Path, list[Seed]], name: str) -> None:
    if not is_installed(name):
        pytest.skip("its package is not installed")
    found = read_damaged(seeds[0], name, 0, _MANY)
    assert found.faults == []
    assert found.files == _MANY
    assert 0 < found.refused < _MANY, "some are refused, and some are so little damaged that they are read"


@pytest.mark.slow
def test_the_same_seed_gives_the_same_damage(seeds: tuple[Path, list[Seed]]) -> None:
    for seed in seeds[1]:
        data = seed.damaged.read_bytes()
        copies = [mutated(data, seed=str(k)) for k in range(20)]
        assert copies == [mutated(data, seed=str(k)) for k in range(20)]
        assert len(set(copies)) > 10
        assert max(map(len, copies)) <= LARGEST
