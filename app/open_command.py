"""The command that opens the inputs of a registration in the workbench, for a shell."""

from __future__ import annotations

import os
from pathlib import Path

from ladarreg_core.foundations.shell_command import shell_command

from .arguments import CameraArguments, InputArguments, ScanArguments


def open_command(arguments: InputArguments) -> str:
    """Return `ladarreg serve SCAN PHOTO ...` with every option that says how the inputs are read.

    Paths are absolute, so that the command works in any folder; it is quoted for the system's shell.
    """
    files = (arguments.scan, *(arguments.more or ()), arguments.photo)
    words = ["ladarreg", "serve", *(os.path.abspath(path) for path in files)]
    names = [*ScanArguments.__annotations__, *CameraArguments.__annotations__, "matches", "initial"]
    for name in names:
        value = getattr(arguments, name)
        if name == "GROUP" or value == getattr(InputArguments, name):
            continue
        text = os.path.abspath(value) if isinstance(value, Path) else str(value)
        flag = f"--{name.replace('_', '-')}"
        # a value that begins with a hyphen would be taken for an option
        words += [f"{flag}={text}"] if text.startswith("-") else [flag, text]
    return shell_command(words)
