"""`ladarreg audit SCAN PHOTO --pose POSE`, `ladarreg audit SURVEY`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from ..arguments import CameraArguments, OptionalPath
from ..exit_codes import ExitCode
from ..progress_bar import progress_bar

if TYPE_CHECKING:
    from ladarreg_core.camera import CameraModel

EXAMPLES = (
    "ladarreg audit scan.e57 photo.jpg --camera camera.json --pose pose.json",
    "# a registration of last month, against the images of today:",
    "ladarreg audit scan.e57 photo.jpg --pose results/registration.json",
    "# the poses that an earlier adjustment of a survey found:",
    "ladarreg audit survey.json --pose results",
)
_CODES = {"right": ExitCode.ACCEPTED, "wrong": ExitCode.NOT_ACCEPTED, "undecidable": ExitCode.UNDECIDABLE}


@dataclass(frozen=True, kw_only=True)
class Arguments(CameraArguments):
    """Arguments of `audit`."""

    scan: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SCAN|SURVEY")]
    """The scan; or a survey.json, or a folder with scans and photographs, whose poses are judged together."""
    photo: Annotated[tyro.conf.Positional[OptionalPath], tyro.conf.arg(metavar="[PHOTO]")] = None
    """The photo; none with a survey."""
    pose: Annotated[OptionalPath, tyro.conf.arg(metavar="FILE")] = None
    """The pose that is used: a pose JSON (scanner or world), a registration.json, or transforms.json. Without --camera,
    the camera of a registration.json is the one that is used with it. Of a survey: the results of an earlier adjust;
    default: the poses that it states."""
    seed: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Random seed."""
    json: bool = False
    """Print the result as JSON, and nothing else, on stdout; errors, too."""
    quiet: bool = False
    """Print no progress."""
    debug: bool = False
    """Print a log, and a traceback on failure."""


def run(arguments: Arguments) -> ExitCode:
    """Say whether a calibration that is used, or those of a survey, are right, wrong or undecidable."""
    from ladarreg_core.errors import OptionError
    from ladarreg_core.survey.survey_file import is_survey_file

    if arguments.photo is None and (arguments.scan.is_dir() or is_survey_file(arguments.scan)):
        return _audit_survey(arguments)
    if arguments.photo is None:
        raise OptionError(f"{arguments.scan.name} is no survey; give the photo and --pose, or a survey.json alone")
    if arguments.pose is None:
        raise OptionError("no pose is given that could be judged; give it by --pose")
    return _audit_pair(arguments, arguments.photo, arguments.pose)


def _audit_survey(arguments: Arguments) -> ExitCode:
    from ladarreg_core.registration.register import RegisterOptions
    from ladarreg_core.survey.survey import Survey
    from ladarreg_core.survey.survey_audit import StatedPoses, audit_survey

    stated = None if arguments.pose is None else StatedPoses.of_adjustment(arguments.pose)
    with progress_bar(quiet=arguments.quiet or arguments.json) as bar:
        survey = Survey.from_file(arguments.scan)
        found = audit_survey(survey, stated, options=RegisterOptions(seed=arguments.seed), report=bar.progress)
    if arguments.json:
        from ..json_output import print_json

        print_json(found.as_fields())
    else:
        for name, one in found.photos.items():
            print(f"{one.outcome.capitalize():<12}{name}: {one.sentence}")
        for name, why in found.left_out.items():
            print(f"{'Not judged':<12}{name}: {why}")
        print(f"{found.outcome.capitalize()}. {found.sentence}")
    return _CODES[found.outcome]


def _audit_pair(arguments: Arguments, photo_file: Path, pose_file: Path) -> ExitCode:
    from ladarreg_core.formats import read_photo, read_scan
    from ladarreg_core.formats.documents.pose_file import read_initial
    from ladarreg_core.foundations.formatting import format_angle, format_length
    from ladarreg_core.registration.register import RegisterOptions
    from ladarreg_core.survey.audit import audit

    with progress_bar(quiet=arguments.quiet or arguments.json) as bar:
        scan = read_scan(arguments.scan, report=bar.progress, **arguments.scan_options)
        given = arguments.photo_options
        camera = None if any(value is not None for value in given.values()) else _camera_with(pose_file)
        photo = read_photo(photo_file, **({"camera": camera} if camera is not None else given))
        pose = read_initial(pose_file, scan.world_from_scanner, picture=photo_file.name)
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
    return _CODES[found.outcome]


def _camera_with(pose: Path) -> CameraModel | None:
    """Return the camera that a file states together with its pose; None: it is no registration."""
    from ladarreg_core.errors import FormatError
    from ladarreg_core.formats import read_registration

    try:
        return read_registration(pose).camera
    except FormatError:
        return None
