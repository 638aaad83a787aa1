"""The command that opens the inputs of a registration in the workbench, for a shell."""

from __future__ import annotations

from ladarreg_core.foundations.shell_command import serve_command

from .arguments import InputArguments, PhotoCameraArguments, ScanArguments


def open_command(arguments: InputArguments) -> str:
    """Return `ladarreg serve SCAN PHOTO ...` with every option that says how the inputs are read."""
    names = [*ScanArguments.__annotations__, *PhotoCameraArguments.__annotations__, "matches", "initial"]
    given = {
        name: value for name in names
        if name != "GROUP" and (value := getattr(arguments, name)) != getattr(InputArguments, name)
    }  # fmt: skip
    return serve_command([arguments.scan, *(arguments.more or ()), arguments.photo], given)
