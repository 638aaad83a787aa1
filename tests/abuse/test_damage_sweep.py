"""A sweep over a project: flipped bits, missing files, emptied files; everything else must remain."""

from __future__ import annotations

from pathlib import Path

import pytest

from testing.attacks.project_damage import Reference, flipped, make_project, missing, opened_by_the_workbench


@pytest.fixture(scope="session")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Reference:
    return make_project(tmp_path_factory.mktemp("reference") / "project")


@pytest.fixture(autouse=True)
def own_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LADARREG_HOME", str(tmp_path / "home"))


@pytest.mark.slow
@pytest.mark.parametrize(
    "flips", [range(10), pytest.param(range(10, 200), marks=pytest.mark.long)], ids=["few", "many"]
)
def test_one_flipped_bit_loses_only_what_it_hit(reference: Reference, tmp_path: Path, flips: range) -> None:
    damaged = [flipped(reference, tmp_path, seed=str(k)) for k in flips]
    assert [f"{found.what}: {text}" for found in damaged for text in found.losses] == []


@pytest.mark.parametrize("emptied", [False, True])
def test_one_missing_file_loses_only_its_content(reference: Reference, tmp_path: Path, emptied: bool) -> None:
    damaged = [missing(reference, tmp_path, name, emptied=emptied) for name in reference.files()]
    assert len(damaged) >= 5
    assert [f"{found.what}: {text}" for found in damaged for text in found.losses] == []


@pytest.mark.parametrize("name", ["project.json", "history.jsonl"])
def test_the_workbench_shows_what_the_other_file_holds(reference: Reference, tmp_path: Path, name: str) -> None:
    assert opened_by_the_workbench(reference, tmp_path, name) == reference.document
