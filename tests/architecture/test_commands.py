"""What every command of the command line must have."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

COMMANDS = Path(__file__).resolve().parents[2] / "app" / "commands"


@pytest.mark.parametrize("path", sorted(COMMANDS.glob("[a-z]*.py")), ids=lambda path: path.stem)
def test_every_command_has_examples_for_its_help(path: Path) -> None:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    named = {
        target.id: node.value
        for node in tree.body
        if isinstance(node, ast.Assign)
        for target in node.targets
        if isinstance(target, ast.Name)
    }
    assert "EXAMPLES" in named, "add EXAMPLES = (...), command lines for the end of --help; see commands/register.py"
    examples = ast.literal_eval(named["EXAMPLES"])
    assert isinstance(examples, tuple)
    assert any(example.startswith(f"ladarreg {path.stem.replace('_', '-')}") for example in examples)
    assert all(len(example) < 78 for example in examples)
