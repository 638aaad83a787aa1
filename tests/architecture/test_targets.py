"""The table of export targets in docs/outputs.md is that of the program, and each target has a section there."""

from __future__ import annotations

import re
from pathlib import Path

from ladarreg_core.export.targets.registry import TARGETS

PAGE = (Path(__file__).parents[2] / "docs" / "outputs.md").read_text(encoding="utf-8")
HERE = "docs/outputs.md, 'Exports to other programs'"


def test_the_table_of_targets_is_complete() -> None:
    section = PAGE.split("\n## Exports to other programs\n")[1].split("\n## ")[0]
    rows = re.findall(r"^\| `.*$", section, re.MULTILINE)
    wanted = [f"| `{target.name}` | {target.title} | {target.purpose} |" for target in TARGETS]
    assert rows == wanted, f"the rows of {HERE}, have to be these:\n" + "\n".join(wanted)


def test_each_target_has_a_section() -> None:
    sections = set(re.findall(r"^## (.*)$", PAGE, re.MULTILINE))
    missing = [target.name for target in TARGETS if target.name not in sections]
    assert not missing, f"docs/outputs.md has no section '## {missing[0]}': files, conventions, how to open it, limits"
