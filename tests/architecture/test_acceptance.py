"""Acceptance in one place: documented, and every threshold is used in a decision."""

from __future__ import annotations

import json
import re
from dataclasses import asdict, fields
from pathlib import Path

import pytest

import ladarreg_core
from ladarreg_core.matching.verify.verification import GateOptions
from ladarreg_core.pose.acceptance import AcceptanceOptions
from tests.architecture.acceptance_table import PAGE, field_docstrings, page_with_tables

CORE = Path(ladarreg_core.__file__).parent


def test_the_page_lists_every_threshold() -> None:
    page = PAGE.read_text(encoding="utf-8")
    assert page == page_with_tables(page), "run python -m tests.architecture.acceptance_table"


@pytest.mark.parametrize("options", [AcceptanceOptions, GateOptions])
def test_every_threshold_is_documented_and_saved(options: type) -> None:
    names = [field.name for field in fields(options)]
    assert list(field_docstrings(options)) == names
    saved = asdict(options())
    assert json.loads(json.dumps(saved)) == saved


@pytest.mark.parametrize(("options", "room"), [(AcceptanceOptions, "pose"), (GateOptions, "matching")])
def test_every_threshold_is_used(options: type, room: str) -> None:
    text = "\n".join(path.read_text(encoding="utf-8") for path in (CORE / room).rglob("*.py"))
    used = set(re.findall(r"(?:\b(?:o|options|acceptance|gate|self)|GateOptions\(\)\))\.(\w+)", text))
    assert {field.name for field in fields(options)} <= used
