"""The table of export targets in docs/outputs.md is that of the program; each has a section, in its order."""

from __future__ import annotations

import re
from pathlib import Path

from ladarreg_core.export.targets.registry import TARGETS

PAGE = (Path(__file__).parents[2] / "docs" / "outputs.md").read_text(encoding="utf-8")
NAMES = [target.name for target in TARGETS]
HERE = "docs/outputs.md, 'Which target for which program'"
OPENING = PAGE.split("\n## Which target for which program\n")[1].split("\n## ")[0]


def test_the_table_of_targets_is_complete() -> None:
    rows = re.findall(r"^\| \[`.*$", OPENING, re.MULTILINE)
    wanted = [f"| [`{target.name}`](#{target.name}) | {target.title} | {target.purpose} |" for target in TARGETS]
    assert rows == wanted, f"the rows of {HERE}, have to be these:\n" + "\n".join(wanted)


def test_the_table_of_programs_names_every_target_and_no_other() -> None:
    rows = re.findall(r"^\| ([^|]+) \| ([^|]+) \|$", OPENING, re.MULTILINE)
    named = {name for _, targets in rows for name in re.findall(r"`(\w+)`", targets)}
    assert named == {*NAMES}, f"the table of programs in {HERE}"


def test_each_target_has_a_section_in_the_order_of_the_table() -> None:
    sections = [name for name in re.findall(r"^## (.*)$", PAGE, re.MULTILINE) if name in NAMES]
    missing = [name for name in NAMES if name not in sections]
    assert not missing, f"docs/outputs.md has no section '## {missing[0]}': files, conventions, how to open it, limits"
    assert sections == NAMES
