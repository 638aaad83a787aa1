"""`ladarreg audit SCAN PHOTO --pose POSE`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from ..arguments import CameraArguments
from ..exit_codes import ExitCode
from ..progress_bar import progress_bar

if TYPE_CHECKING:
    from ladarreg_core.camera import CameraModel

EXAMPLES = (
    "ladarreg audit scan.e57 photo.jpg --camera camera.json --pose calibration.json",
    "# a registration of last month, against the images of today:",
    "ladarreg audit scan.e57 photo.jpg --pose results/registration.json",
)


@dataclass(frozen=True, kw_only=True)
class Arguments(CameraArguments):
    """Arguments of `audit`."""

    scan: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SCAN")]
    """The scan."""
    photo: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="PHOTO")]
    """The photo."""
    pose: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """The pose that is used: a pose JSON (scanner or world), a registration.json, or transforms.json. Without --camera,
    the camera of a registration.json is the one that is used with it."""
    seed: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Random seed."""
    json: bool = False
    """Print the result as JSON, and nothing else, on stdout; errors, too."""
    quiet: bool = False
    """Print no progress."""
    debug: bool = False
    """Print a log, and a traceback on failure."""


def run(arguments: Arguments) -> ExitCode:
    """Say whether a calibration that is used is right, wrong or undecidable."""
    from ladarreg_core.formats import read_photo, read_scan
    from ladarreg_core.formats.documents.pose_file import read_initial
    from ladarreg_core.foundations.formatting import format_angle, format_length
    from ladarreg_core.registration.register import RegisterOptions
    from ladarreg_core.survey.audit import audit

    with progress_bar(quiet=arguments.quiet or arguments.json) as bar:
        scan = read_scan(arguments.scan, report=bar.progress, **arguments.scan_options)
        given = arguments.photo_options
        camera = None if any(value is not None for value in given.values()) else _camera_with(arguments.pose)
        photo = read_photo(arguments.photo, **({"camera": camera} if camera is not None else given))
        pose = read_initial(arguments.pose, scan.world_from_scanner, picture=arguments.photo.name)
        found = audit(scan, photo, pose, options=RegisterOptions(seed=arguments.seed), report=bar.step)
    if arguments.json:
        from ..json_output import print_json

        print_json(found.as_fields())
    else:
        print(f"{found.outcome.capitalize()}. {found.sentence}")
        for name, points, shown in (
            ("Rotation", found.rotation_power, format_angle),
            ("Position", found.position_power, format_length),
        ):
            words = ", ".join(f"{shown(one.size)} {one.probability:.0%}" for one in points)
            if words:
                print(f"{name:<9} errors seen: {words}")
    codes = {"right": ExitCode.ACCEPTED, "wrong": ExitCode.NOT_ACCEPTED, "undecidable": ExitCode.UNDECIDABLE}
    return codes[found.outcome]


def _camera_with(pose: Path) -> CameraModel | None:
    """Return the camera that a file states together with its pose; None: it is no registration."""
    from ladarreg_core.errors import FormatError
    from ladarreg_core.formats import read_registration

    try:
        return read_registration(pose).camera
    except FormatError:
        return None
