"""`ladarreg adjust SURVEY -o OUT`."""

from __future__ import annotations

import os
import time
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from ..exit_codes import ExitCode
from ..messages import one_line
from ..progress_bar import progress_bar

if TYPE_CHECKING:
    from ladarreg_core.survey.survey import Survey

EXAMPLES = (
    "ladarreg adjust survey.json -o results",
    "# a folder; after an interruption, the same command goes on:",
    "ladarreg adjust job -o results --processes 4",
)


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Arguments of `adjust`."""

    survey: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SURVEY")]
    """A survey.json, a folder with scans and photographs, or a project of the workbench."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT")]
    """Output folder: a new one, or that of an earlier run, which is resumed."""
    processes: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Worker processes; by default one for each processor core."""
    cache: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Keep what costs time in this folder for further runs; by default it is kept in OUT until that is complete."""
    seed: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Random seed."""
    force: bool = False
    """Replace OUT if it contains earlier results and nothing else; any other folder is never touched."""
    json: bool = False
    """Print adjustment.json, and nothing else, on stdout; errors, too."""
    quiet: bool = False
    """Print no progress."""
    debug: bool = False
    """Print a log, and a traceback on failure."""


def run(arguments: Arguments) -> ExitCode:
    """Solve the survey and write the results."""
    from ladarreg_core.batches.photos.cache import ContentCache
    from ladarreg_core.foundations.formatting import format_angle, format_length
    from ladarreg_core.registration.register import RegisterOptions
    from ladarreg_core.storage.manifest import visible_files
    from ladarreg_core.survey.outputs import write_adjustment

    started = time.perf_counter()
    survey = _survey(arguments.survey)
    with progress_bar(quiet=arguments.quiet or arguments.json) as bar:
        found = write_adjustment(
            survey, arguments.out, options=RegisterOptions(seed=arguments.seed),
            processes=arguments.processes, force=arguments.force, report=bar.progress,
            cache=None if arguments.cache is None else ContentCache(arguments.cache),
        )  # fmt: skip
    code = ExitCode.ACCEPTED if found.accepted else ExitCode.NOT_ACCEPTED
    if arguments.json:
        from ..json_output import print_json

        output = {"folder": os.path.abspath(arguments.out), "files": visible_files(arguments.out)}
        print_json({**found.document(), "output": output})
        return code
    for name, scan in found.scans.items():
        print(f"Scan     {name}: {one_line(' '.join(scan.reasons))}")
    for name, photo in found.photos.items():
        sigma = (
            f" Sigma {format_length(photo.sigma_position_m)}, {format_angle(photo.sigma_angle_rad)}."
            if photo.accepted
            else ""
        )
        print(f"Photo    {name}: {photo.verdict}{sigma} {one_line(photo.reasons[0])}")
    for name, camera in found.cameras.items():
        focal = camera.camera.as_pinhole
        sigma = f" +- {camera.sigmas['focal_px']:.2f}" if "focal_px" in camera.sigmas else ""
        shown = f"focal length {focal.focal_px:.2f}{sigma} px" if focal is not None else "as given"
        print(f"Camera   {name}: {shown}, {len(camera.photos)} photos")
    for tie in found.ties:
        print(f"Tie      {tie.id} of {' and '.join(tie.photos)}: {tie.reason}")
    for line in found.lines:
        print(f"Line     {line.id} of {', '.join(line.photos)}: {line.reason}")
    accepted = sum(one.accepted for one in found.photos.values())
    noise = f"; noise of the ties {found.sigma_px:.2f} px" if found.residuals else ""
    print(f"Accepted {accepted} of {len(found.photos)} photos{noise}")
    print(f"Wrote    {', '.join(visible_files(arguments.out)[:6])} ... in {arguments.out}")
    print(f"Took     {time.perf_counter() - started:.1f} s")
    return code


def _survey(path: Path) -> Survey:
    """Return the survey of a file, a folder or a project.

    Raises:
        LadarregError: if it has faults; all are listed.
    """
    from ladarreg_core.export.outputs.project_survey import survey_of_project
    from ladarreg_core.project.storage.folder import ProjectFolder, is_project
    from ladarreg_core.survey.survey import Survey

    if not is_project(path):
        return Survey.from_file(path)
    with closing(ProjectFolder(path)) as folder:
        return survey_of_project(folder.read().document, folder)
