"""The README's example runs unchanged, and its links, targets and commands exist."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from ladarreg.cli import COMMANDS


@pytest.mark.slow
def test_the_example_runs(tmp_path: Path, checkout: Path) -> None:
    (example,) = re.findall(r"```python\n(.*?)```", (checkout / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    assert len([line for line in example.splitlines() if line.strip()]) <= 11
    code = f"import sys; sys.path.insert(0, {str(checkout)!r})\n{example}"
    result = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert result.returncode == 0, result.stderr
    assert result.stdout.startswith("True")
    assert (tmp_path / "results" / "model.glb").is_file()


def test_links_targets_and_commands_exist(checkout: Path) -> None:
    text = (checkout / "README.md").read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#:]+)\)", text):
        assert (checkout / target).exists(), target
    targets = set(re.findall(r"^make (\w+)", text, re.MULTILINE))
    assert targets == {"demo", "test"}
    makefile = (checkout / "Makefile").read_text(encoding="utf-8")
    assert all(re.search(rf"^{target}:", makefile, re.MULTILINE) for target in targets)
    assert set(re.findall(r"^ladarreg (\w+)", text, re.MULTILINE)) <= set(COMMANDS)
