"""Every step of a registration has a label."""

from __future__ import annotations

import re
from pathlib import Path

from ladarreg_core.matching.step_labels import STEP_LABELS, step_label


def test_every_step_name_has_a_label(checkout: Path) -> None:
    core = checkout / "ladarreg_core"
    folders = (core / "matching", core / "thesis" / "matching", core / "registration" / "rig")
    files = [core / "registration" / "register.py", *(file for folder in folders for file in folder.rglob("*.py"))]
    names = {name for path in files for name in re.findall(r"steps\.step\(\"([^\"]+)\"\)", path.read_text("utf-8"))}
    assert len(names) >= 20
    assert names | {"linear", "constrained linear"} == set(STEP_LABELS)


def test_labels_are_distinct_and_other_names_are_kept() -> None:
    assert len(set(STEP_LABELS.values())) == len(STEP_LABELS)
    assert step_label("second minimum") == "Ambiguity check"
    assert step_label("read scan") == "read scan"
