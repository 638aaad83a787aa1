"""Commands to paste into a shell: the one place that quotes what they name."""

from __future__ import annotations

import os
import shlex
import subprocess
from collections.abc import Iterable


def shell_command(words: Iterable[str | os.PathLike[str]]) -> str:
    """Return a command whose words a shell takes as they are, whatever the files are called.

    Args:
        words: the command and its arguments; of a file name that begins with a hyphen, give the path.
    """
    texts = [os.fspath(word) for word in words]
    return subprocess.list2cmdline(texts) if os.name == "nt" else shlex.join(texts)
