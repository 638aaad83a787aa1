"""`ladarreg check PATH`."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ..exit_codes import ExitCode
from ..json_output import print_json
from ..messages import one_line

EXAMPLES = (
    "ladarreg check results",
    "# a project, the folder of a run, or an export, before it is handed on:",
    "ladarreg check handover --json",
)


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Arguments of `check`."""

    path: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="PATH")]
    """Folder of a project, a result, a run or an export; or a document of results, or an E57 file."""
    json: bool = False
    """Print what was found as one JSON document, and nothing else, on stdout; errors, too."""
    debug: bool = False
    """Print a log, and a traceback on failure."""


def run(arguments: Arguments) -> ExitCode:
    """Compare everything with its checksums, and print what is damaged, one line each."""
    from ladarreg_core.export.outputs.integrity import check_integrity

    found = check_integrity(arguments.path)
    if arguments.json:
        print_json({"path": str(arguments.path), **asdict(found)})
    else:
        for sentence in found.damaged:
            print(f"Damaged  {one_line(sentence)}")
        for note in found.notes:
            print(f"Note     {one_line(note)}")
        state = f"damaged in {len(found.damaged)} places" if len(found.damaged) > 1 else "damaged"
        files = "1 file" if found.files == 1 else f"{found.files} files"
        print(f"Checked  {found.kind}, {files}: {state if found.damaged else 'nothing is damaged'}")
    return ExitCode.BAD_INPUT if found.damaged else ExitCode.ACCEPTED
