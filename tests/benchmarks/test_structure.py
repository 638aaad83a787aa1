"""The figures of `benchmarks.structure`, and options that are there for somebody."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from benchmarks.structure import CHECKOUT, Calls, imported, largest_package, unset_options
from ladarreg_core.frames import Rigid


@pytest.mark.long
def test_an_option_that_nothing_sets_is_documented() -> None:
    pages = "".join(path.read_text(encoding="utf-8") for path in (CHECKOUT / "docs").glob("*.md"))
    unset = {f"{options}.{field}" for options, fields in unset_options().items() for field in fields}
    assert not {name for name in unset if f"`{name.partition('.')[2]}`" not in pages}, "make it a constant, or test it"


@pytest.mark.parametrize(
    ("line", "package"),
    [
        ("from ladarreg_core.frames import Rigid", "ladarreg_core"),
        ("from ladarreg_core.camera import Camera", "ladarreg_core/camera"),
        ("from ladarreg_core.matching.search.roll import Roll", "ladarreg_core/matching/search"),
        ("from ladarreg_core.matching import search", "ladarreg_core/matching/search"),
        ("from ladarreg.cli import main", "app"),
        ("from ..jobs.runner import Runner", "app/jobs"),
        ("from . import state", "app/workbench/state"),
    ],
)
def test_the_package_of_an_imported_name(line: str, package: str) -> None:
    ((found, _),) = imported(Path("app/workbench/desk.py"), ast.parse(line))
    assert found == Path(package)


def test_other_libraries_are_no_packages_of_ours() -> None:
    assert not list(imported(Path("app/cli.py"), ast.parse("from numpy.typing import NDArray\nimport json")))


def test_calls_are_seen_by_module_and_only_while_asked_for() -> None:
    with Calls() as calls:
        pose = Rigid.from_rotvec([0.0, 0.0, 1.0], [1.0, 2.0, 3.0])
    assert "frames.py" in calls.modules
    assert calls.packages()
    seen = len(calls.modules)
    _ = pose.inverse
    assert len(calls.modules) == seen


def test_returns_are_entries_of_a_package_that_was_left() -> None:
    calls = Calls(dict.fromkeys(["scan.py", "camera/a.py", "camera/b.py", "frames.py", "pose/c.py"]))
    assert calls.packages() == [".", "camera", ".", "pose"]


@pytest.mark.slow
@pytest.mark.parametrize("side", ["core", "app"])
def test_every_package_can_be_surveyed(side: str) -> None:
    count, name = largest_package(side)
    assert count <= (26 if name == "app/commands" else 22), name  # one file a command
