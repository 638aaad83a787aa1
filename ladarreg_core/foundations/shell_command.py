"""Commands to paste into a shell: the one place that quotes what they name."""

from __future__ import annotations

import os
import shlex
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any


def shell_command(words: Iterable[str | os.PathLike[str]]) -> str:
    """Return a command whose words a shell takes as they are, whatever the files are called.

    Args:
        words: the command and its arguments; of a file name that begins with a hyphen, give the path.
    """
    texts = [os.fspath(word) for word in words]
    return subprocess.list2cmdline(texts) if os.name == "nt" else shlex.join(texts)


def serve_command(files: Sequence[Path], options: Mapping[str, Any]) -> str:
    """Return the command that opens files in the workbench, for the system's shell and from any folder.

    Args:
        files: the scans, then the photograph.
        options: how they are read: the values of options by their names.
    """
    words = ["ladarreg", "serve", *(os.path.abspath(path) for path in files)]
    for name, value in options.items():
        text = os.path.abspath(value) if isinstance(value, Path) else str(value)
        flag = "--" + name.replace("_", "-")
        # a value that begins with a hyphen would be taken for an option
        words += [f"{flag}={text}"] if text.startswith("-") else [flag, text]
    return shell_command(words)
