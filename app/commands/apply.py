"""`ladarreg apply SCAN PHOTO --pose POSE -o OUT`."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from ..arguments import PhotoArguments
from ..exit_codes import ExitCode
from ..inputs import print_notes, read_inputs, spare_heap, timed, with_photo_named, with_recorded_options
from ..json_output import print_written
from ..messages import report, verdict
from ..progress_bar import progress_bar

EXAMPLES = (
    "ladarreg apply room.e57 photo.jpg --pose pose.json -o coloured",
    "# with the camera and the pose of a reconstruction in the scan's world:",
    "ladarreg apply a.e57 b.jpg --camera cameras.bin --pose cameras.bin -o out",
)


@dataclass(frozen=True, kw_only=True)
class Arguments(PhotoArguments):
    """Arguments of `apply`."""

    pose: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """The pose: a pose JSON (scanner or world), a registration.json, or transforms.json. A registration.json of the
    same files also says with which options and further scans they are read."""
    frame: Literal["scanner", "world"] = "scanner"
    """Coordinates of model.glb and cloud.ply; world: those of the survey, less the offset stated in offset.json."""


def run(arguments: Arguments) -> ExitCode:
    """Read, colour and export with the given pose, and print what the images say of it."""
    from ladarreg_core.export.output_frame import OutputFrame
    from ladarreg_core.export.targets.folder import check_folder, export_registration
    from ladarreg_core.formats.documents.pose_file import read_initial
    from ladarreg_core.quality.assessment import assess
    from ladarreg_core.registration.given import given_pose
    from ladarreg_core.storage.manifest import visible_files

    started = time.perf_counter()
    arguments = with_photo_named(arguments)
    check_folder(arguments.out, force=arguments.force, inputs=[*arguments.input_files, arguments.pose])
    arguments = with_recorded_options(arguments, arguments.pose)
    inputs = [*arguments.input_files, arguments.pose]
    with progress_bar(quiet=arguments.quiet) as bar:
        scan, photo = read_inputs(arguments, bar, arguments.pose)
        OutputFrame.of(scan, arguments.frame)  # refuse before the work
        pose = read_initial(arguments.pose, scan.world_from_scanner, picture=arguments.photo.name)
        result = given_pose(scan, photo, pose, seed=arguments.seed, report=bar.step)
        spare_heap(scan)
        assessment = timed("Assess", bar, lambda: assess(scan, result))
        export_registration(
            arguments.out, result, scan, photo, assessment=assessment, inputs=inputs, read_with=arguments.read_with,
            frame=arguments.frame, force=arguments.force, report=bar.progress,
        )  # fmt: skip
    if arguments.json:
        print_written(arguments.out, "registration.json", scan, photo)
    elif arguments.quiet:
        print(verdict(result))
    else:
        print_notes(scan, photo)
        print(report(result))
        print(f"Wrote    {', '.join(visible_files(arguments.out))} in {arguments.out}")
        print(f"Took     {time.perf_counter() - started:.1f} s")
    return ExitCode.ACCEPTED
