"""`ladarreg survey FOLDER -o survey.json`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ..exit_codes import ExitCode
from ..messages import one_line
from ..progress_bar import progress_bar

EXAMPLES = (
    "ladarreg survey job -o job/survey.json",
    "ladarreg adjust job/survey.json -o results",
)


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Arguments of `survey`."""

    folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FOLDER")]
    """Folder with scans and photographs, recognised by content; or a survey.json, which is checked."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="SURVEY.json")] = None
    """File to write; without it, the survey is only described."""
    force: bool = False
    """Replace the file if it exists."""
    json: bool = False
    """Print the survey, and nothing else, on stdout; errors, too."""
    quiet: bool = False
    """Print no progress."""
    debug: bool = False
    """Print a log, and a traceback on failure."""


def run(arguments: Arguments) -> ExitCode:
    """Describe the survey of a folder or file, and write it."""
    from ladarreg_core.errors import ExportError
    from ladarreg_core.survey.survey import Survey
    from ladarreg_core.survey.survey_file import survey_fields

    if arguments.out is not None and arguments.out.exists() and not arguments.force:
        raise ExportError(f"{arguments.out} exists; give another file, or allow it to be replaced by `force=True`")
    with progress_bar(quiet=arguments.quiet or arguments.json) as bar:
        if arguments.folder.is_dir():
            survey = Survey.from_folder(arguments.folder, report=bar.progress)
        else:
            survey = Survey.from_file(arguments.folder)
    if arguments.out is not None:
        survey.to_file(arguments.out)
    if arguments.json:
        from ..json_output import print_json

        print_json(survey_fields(survey, arguments.out or arguments.folder / "survey.json"))
        return ExitCode.ACCEPTED
    for what, ids in (("Scans", survey.scans), ("Cameras", survey.cameras), ("Photos", survey.photos)):
        print(f"{what:<8} {len(ids):3}  {one_line(', '.join(one.id for one in ids))}")
    for camera in survey.cameras:
        taken = [one.id for one in survey.photos if one.camera == camera.id]
        print(f"  {camera.id}: {len(taken)} photos")
    if arguments.out is not None:
        print(f"Wrote    {arguments.out}")
    return ExitCode.ACCEPTED
