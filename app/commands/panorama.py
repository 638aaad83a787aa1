"""`ladarreg panorama RUN -o OUT`."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from ..arguments import PhotoCameraArguments
from ..exit_codes import ExitCode
from ..messages import one_line
from ..progress_bar import progress_bar

if TYPE_CHECKING:
    from ladarreg_core.frames import Rigid

EXAMPLES = (
    "ladarreg panorama run -o panorama",
    "ladarreg panorama run -o panorama --calibrate-mount --refine",
    "ladarreg panorama run -o panorama --base hanging",
    "ladarreg panorama run -o panorama --calibrate-camera --camera cam.json",
    "# scans of any format with the angles of any pan/tilt unit:",
    "ladarreg panorama pieces.csv -o panorama --mount 0,0,0.08,0,0,0",
)


@dataclass(frozen=True, kw_only=True)
class Arguments(PhotoCameraArguments):
    """Arguments of `panorama`."""

    run: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """Folder of a run of `ladarreg acquire`, or a CSV with file,pan_deg,tilt_deg."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT")]
    """Output folder; an existing one is refused, but see --force."""
    mount: Annotated[str | None, tyro.conf.arg(metavar="X,Y,Z,R,P,Y")] = None
    """Where the scanner is on the unit: m from where the axes cross, then roll, pitch and yaw in degrees; or a JSON
    file with xyz_m and rpy_deg, a plan or a panorama.json. Default: that of the plan."""
    base: Annotated[str | None, tyro.conf.arg(metavar="BASE")] = None
    """How the unit itself is turned: upright, hanging, or roll,pitch,yaw in degrees, as an inclinometer on it measures
    roll and pitch. The panorama is level. Default: mount.base of the plan, else upright."""
    base_sigma: Annotated[str | None, tyro.conf.arg(metavar="DEG")] = None
    """How well an inclinometer measured roll and pitch of the base: a standard deviation in degrees, or two with a
    comma. panorama.json states how level the panorama is. Default: mount.base_sigma_deg of the plan."""
    calibrate_mount: bool = False
    """Estimate the mount from surfaces that were seen twice."""
    calibrate_camera: bool = False
    """Estimate where the camera is mounted, from the photographs of the run; what is known of the camera is said by
    --camera or --focal-px, unless its files do."""
    refine: bool = False
    """Refine the pieces of a mosaic against each other, where they overlap."""
    partial: bool = False
    """Compose what is there of a run that is not complete."""
    force: bool = False
    """Replace OUT if it contains an earlier panorama and nothing else; any other folder is never touched."""
    json: bool = False
    """Print panorama.json, and nothing else, on stdout; errors, too."""
    quiet: bool = False
    """Print no progress."""
    debug: bool = False
    """Print a log, and a traceback on failure."""


def run(arguments: Arguments) -> ExitCode:
    """Compose the pieces and write `scan.npz`, `panorama.json` and `provenance.png`."""
    from ladarreg_core.acquisition.composition.panorama import compose, write_panorama
    from ladarreg_core.export.outputs.run_camera import calibrate_run_camera, photo_poses
    from ladarreg_core.export.targets.folder import check_folder
    from ladarreg_core.formats.documents.panorama_info import panorama_lines
    from ladarreg_core.storage.manifest import visible_files

    started, base = time.perf_counter(), _base(arguments.base)
    check_folder(arguments.out, force=arguments.force, inputs=[arguments.run])
    with progress_bar(quiet=arguments.quiet or arguments.json) as bar:
        made = compose(
            arguments.run, mount=_mount(arguments.mount), base=base,
            base_sigma_deg=_base_sigma(arguments.base_sigma),
            calibrate_mount=arguments.calibrate_mount, refine=arguments.refine, partial=arguments.partial,
            report=bar.progress,
        )  # fmt: skip
        camera = None
        if arguments.calibrate_camera:
            camera = calibrate_run_camera(
                arguments.run, made, base=base, photo_options=arguments.photo_options, report=bar.progress
            )
            made = replace(made, fields={**made.fields, "camera": camera.as_dict()})
        mount = camera.unit_from_camera if camera is not None and camera.accepted else None
        poses = {} if camera is not None and mount is None else photo_poses(arguments.run, mount, base=base)
        write_panorama(
            arguments.out, made, poses=poses, inputs=[arguments.run], force=arguments.force, report=bar.progress
        )
    accepted = made.accepted and (camera is None or camera.accepted)
    if arguments.json:
        from ..json_output import print_json

        files = visible_files(arguments.out)
        print_json({**made.fields, "output": {"folder": os.path.abspath(arguments.out), "files": files}})
        return ExitCode.ACCEPTED if accepted else ExitCode.NOT_ACCEPTED
    for name, value in panorama_lines(made.fields):
        print(f"{name.capitalize():<10} {one_line(value)}")
    also = f", and {len(poses)} poses of photographs" if poses else ""
    print(f"Wrote      scan.npz, panorama.json, provenance.png{also} in {arguments.out}")
    print(f"Took       {time.perf_counter() - started:.1f} s")
    return ExitCode.ACCEPTED if accepted else ExitCode.NOT_ACCEPTED


def _mount(text: str | None) -> Rigid | None:
    if text is None:
        return None
    from ladarreg_core.acquisition.composition.panorama import mount_of_text

    return mount_of_text(text)


def _base(text: str | None) -> Rigid | None:
    if text is None:
        return None
    from ladarreg_core.acquisition.mount_fields import base_of_text

    return base_of_text(text)


def _base_sigma(text: str | None) -> tuple[float, float] | None:
    if text is None:
        return None
    from ladarreg_core.acquisition.mount_fields import base_sigma_of_text

    return base_sigma_of_text(text)
