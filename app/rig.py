"""`ladarreg register --rig FILE`: pairs of a scanner and cameras that are mounted together, in a table or recording."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

import tyro

from .arguments import CameraArguments, OptionalInt, OptionalStr
from .exit_codes import ExitCode
from .messages import one_line
from .progress_bar import progress_bar

if TYPE_CHECKING:
    from ladarreg_core.registration.rig.results import RigResult

EXAMPLES = (
    "ladarreg register --rig pairs.csv --camera cam.json -o rig",
    "# from a rough pose, within some 5 degrees and .3 m:",
    "ladarreg register --rig pairs.csv --camera cam.json --initial pose.json -o rig",
    "# clouds and pictures of a recording, the camera as its camera_info says:",
    "ladarreg register --rig run.mcap --cloud /points --image /image -o rig",
)


@dataclass(frozen=True, kw_only=True)
class RigArguments(CameraArguments):
    """Arguments of `register` with a rig."""

    GROUP: ClassVar[tuple[int, str]] = (0, "options")
    rig: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """Table of the pairs (CSV): a header with scan and photo, and perhaps camera, more, name; paths from its folder. Or
    a recording with clouds and pictures (.bag, .mcap, .db3, or its folder)."""
    cloud: Annotated[OptionalStr, tyro.conf.arg(metavar="TOPIC")] = None
    """Topic of the clouds in a recording; default: the only one."""
    image: Annotated[tuple[str, ...], tyro.conf.arg(metavar="TOPIC")] = ()
    """Topics of pictures in a recording, one for each camera; default: the only one."""
    frames: Annotated[OptionalInt, tyro.conf.arg(metavar="N")] = None
    """Most pairs that are chosen of a recording, at different places (8)."""
    deskewed: bool = False
    """The clouds of a recording are corrected for the motion of the scanner."""
    estimate_time_offset: bool = False
    """Estimate by how much the pictures of a recording are stamped later than its clouds, where the rig moves."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT")]
    """Output folder; an existing one is refused, but see --force."""
    initial: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """A rough pose of the camera relative to the scanner, to begin with: a pose JSON; of several cameras an earlier
    rig.json."""
    seed: int = 0
    """Random seed; equal seeds give equal results."""
    force: bool = False
    """Replace OUT if it contains an earlier rig and nothing else; any other folder is never touched."""
    quiet: bool = False
    """Print no progress, and the verdict in one line."""
    json: bool = False
    """Print rig.json, and nothing else, on stdout; errors, too."""
    debug: bool = False
    """Print a log, and a traceback on failure."""


def run_rig(arguments: RigArguments) -> ExitCode:
    """Read the pairs, register them together, write the results, and print the verdict."""
    from ladarreg_core.export.outputs.rig_folder import is_recording, read_rig, rig_files_of, write_rig
    from ladarreg_core.export.targets.folder import check_folder
    from ladarreg_core.formats.documents.own_results import edited_note
    from ladarreg_core.formats.documents.pose_file import read_initial_of_rig
    from ladarreg_core.registration.rig.options import RigOptions
    from ladarreg_core.registration.rig.registration import register_rig
    from ladarreg_core.storage.manifest import visible_files

    started = time.perf_counter()
    common = [path for path in (arguments.camera, arguments.initial) if path is not None]
    first, *others = rig_files_of(arguments.rig)
    inputs = list(dict.fromkeys([first, *common, *others]))
    check_folder(arguments.out, force=arguments.force, inputs=inputs)
    initial = None if arguments.initial is None else read_initial_of_rig(arguments.initial)
    said = "" if arguments.initial is None else edited_note(arguments.initial)
    with progress_bar(quiet=arguments.quiet or arguments.json) as bar:
        pairs = read_rig(
            arguments.rig, cloud=arguments.cloud, images=arguments.image, frames=arguments.frames,
            deskewed=arguments.deskewed, neighbors=arguments.estimate_time_offset,
            scan_options=arguments.scan_options, photo_options=arguments.photo_options,
            report=bar.progress,
        )  # fmt: skip
        options = RigOptions(seed=arguments.seed, estimate_time_offset=arguments.estimate_time_offset)
        result = register_rig(pairs, initial=initial, options=options, report=bar.step)
        fields = write_rig(
            arguments.out, result, pairs=pairs, inputs=inputs, force=arguments.force, report=bar.progress
        )  # fmt: skip
    files, edited = visible_files(arguments.out), [said] if said else []
    if arguments.json:
        from .json_output import print_json

        notes = [f"{pair.name}: {note}" for pair in pairs for note in (*pair.scan.notes, *pair.photo.notes)]
        print_json(
            {**fields, "notes": [*edited, *notes], "output": {"folder": os.path.abspath(arguments.out), "files": files}}
        )
    elif arguments.quiet:
        print(_verdict(result))
    else:
        chosen = [note for pair in pairs for note in pair.photo.notes] if is_recording(arguments.rig) else []
        print(
            "\n".join([*(f"Note     {one_line(note)}" for note in dict.fromkeys([*edited, *chosen])), *_lines(result)])
        )
        print(f"Wrote    {', '.join(files)} in {arguments.out}")
        print(f"Took     {time.perf_counter() - started:.1f} s")
    return ExitCode.ACCEPTED if result.accepted else ExitCode.NOT_ACCEPTED


def _verdict(result: RigResult) -> str:
    if result.by_camera:
        refused = [name for name, one in result.by_camera.items() if not one.accepted]
        cameras = f"{len(result.by_camera) - len(refused)} of {len(result.by_camera)} cameras accepted"
        return f"{cameras}; not {', '.join(refused)}." if refused else f"Accepted: {cameras}, each by pairs held out."
    return "Accepted: verified by pairs that were held out." if result.accepted else "Not accepted."


def _lines(result: RigResult) -> list[str]:
    lines = [_verdict(result)]
    for name, one in result.by_camera.items():
        first, *others = _lines(one)
        lines += ["", f"{name}: {first[:1].lower()}{first[1:]}", *others]
    if result.by_camera:
        return lines
    pose, sigma = result.camera_from_scanner, result.sigmas
    if result.accepted and pose is not None:
        from ladarreg_core.frames import ThesisParameters

        six = ThesisParameters.from_pose(pose)
        lines += [
            f"Camera   {six.describe_position()}; {six.describe_orientation()}",
            f"Sigma    {sigma.angle_deg:.2g} deg, {sigma.position_mm:.2g} mm",
        ]
    lines += [f"Pair     {one_line(one.sentence)}" for one in result.pairs]
    return [*lines, *(f"Why      {one_line(reason)}" for reason in result.reasons)]
