"""Commands to paste: a shell passes on what they name, and runs none of it."""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ladarreg_core.foundations.shell_command import shell_command

_NAMES = st.text(st.characters(exclude_characters="\0", exclude_categories=("Cs",)), max_size=30)


@pytest.mark.skipif(sys.platform == "win32", reason="the shell there is another one")
@given(st.lists(_NAMES, min_size=1, max_size=5))
def test_words_come_back_from_the_command(words: list[str]) -> None:
    assert shlex.split(shell_command(words)) == words


@pytest.mark.skipif(sys.platform == "win32", reason="the shell there is another one")
def test_a_shell_runs_nothing_that_a_name_contains(tmp_path: Path) -> None:
    names = ["$(touch there)", "`touch there`", "a; touch there", "a\ntouch there", "'; touch there; '", "*", "~", "-x"]
    echo = [sys.executable, "-c", "import json, sys; print(json.dumps(sys.argv[1:]))", *names]
    done = subprocess.run(["sh", "-c", shell_command(echo)], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == names
    assert not any(tmp_path.iterdir())


def test_no_command_is_put_together_elsewhere(checkout: Path) -> None:
    """Everything that quotes for a shell is in one module."""
    for folder in ("app", "ladarreg_core"):
        for file in (checkout / folder).rglob("*.py"):
            quotes = any(word in file.read_text(encoding="utf-8") for word in ("import shlex", "list2cmdline"))
            assert not quotes or file.name == "shell_command.py", file
