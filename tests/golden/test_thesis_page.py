"""docs/thesis.md names code and checks: all of them exist."""

from __future__ import annotations

import importlib
import re
from functools import cache
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parents[2]
PAGE = (CHECKOUT / "docs" / "thesis.md").read_text(encoding="utf-8")
QUOTED = sorted(set(re.findall(r"`([^`\n]+)`", PAGE)) | set(re.findall(r"\((ladarreg_core\.[\w.]+)\)", PAGE)))


@cache
def all_tests() -> str:
    return "\n".join(path.read_text(encoding="utf-8") for path in (CHECKOUT / "tests").rglob("test_*.py"))


@pytest.mark.parametrize("name", [word for word in QUOTED if word.startswith("ladarreg_core.")])
def test_the_code_it_names_exists(name: str) -> None:
    parts = name.split(".")
    for cut in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:cut]))
        except ModuleNotFoundError:
            continue
        for part in parts[cut:]:
            found = getattr(found, part)
        return
    pytest.fail(f"{name} does not exist")


@pytest.mark.parametrize("name", [word for word in QUOTED if word.startswith("test_")])
def test_the_checks_it_names_exist(name: str) -> None:
    assert f"def {name}(" in all_tests()


@pytest.mark.parametrize("name", [word for word in QUOTED if re.fullmatch(r"[\w/]+\.(py|md|png)", word)])
def test_the_files_it_names_exist(name: str) -> None:
    assert (CHECKOUT / name).is_file()


def test_enough_was_read() -> None:
    assert len([word for word in QUOTED if word.startswith("ladarreg_core.")]) > 25
