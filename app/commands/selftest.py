"""`ladarreg selftest SCAN --camera FILE`."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from ..arguments import ScanArguments
from ..exit_codes import ExitCode
from ..inputs import timed
from ..json_output import print_json
from ..messages import self_test_report
from ..progress_bar import progress_bar

if TYPE_CHECKING:
    from ladarreg_core.camera import Camera

EXAMPLES = ("ladarreg selftest room.e57 --camera camera.json --photos 30 --seconds 300",)


@dataclass(frozen=True, kw_only=True)
class Arguments(ScanArguments):
    """Arguments of `selftest`."""

    scan: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SCAN")]
    """Scan: E57, PTX, LAS, LAZ, PLY, PTS, XYZ, CSV, PCD, bag, MCAP, PCAP, NPZ ..."""
    camera: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """Camera of the planned photos: JSON, OpenCV, ROS, Kalibr, COLMAP, nerfstudio or Agisoft."""
    photos: int = 20
    """Number of photos registered without an initial pose."""
    starts: int = 9
    """Number of photos registered from an initial pose that is off by 3, 6 or 12 degrees."""
    wrong: int = 10
    """Number of photos of other scenes, which must be refused."""
    seconds: float = 120.0
    """Time limit; the kinds of trials take turns."""
    seed: int = 0
    """Random seed; equal seeds give equal results."""
    quiet: bool = False
    """Print no progress, and the expectation in one line."""
    json: bool = False
    """Print the result as one JSON document, and nothing else, on stdout; errors, too."""
    debug: bool = False
    """Print a log, and a traceback on failure."""


def run(arguments: Arguments) -> ExitCode:
    """Register photos rendered from the scan and print the expectation; exit code 3 if a wrong pose was accepted."""
    import ladarreg_core as lr
    from ladarreg_core.registration.self_test.report import self_test
    from ladarreg_core.registration.self_test.trials import SelfTestOptions

    options = SelfTestOptions(
        photos=arguments.photos,
        starts=arguments.starts,
        wrong=arguments.wrong,
        seconds=arguments.seconds,
        seed=arguments.seed,
    )
    with progress_bar(quiet=arguments.quiet) as bar:
        camera = _camera(arguments.camera)
        scan = timed(
            "Read scan", bar, lambda: lr.read_scan(arguments.scan, report=bar.loading, **arguments.scan_options)
        )
        found = self_test(scan, camera, options, report=bar.progress)
    if arguments.json:
        names = ("accepted_wrongly", "position_mm", "angle_deg", "picture_px", "start_deg")
        figures = {name: getattr(found, name) for name in names}
        print_json({"summary": found.summary(), **figures, "trials": [asdict(trial) for trial in found.trials]})
    else:
        print(found.summary() if arguments.quiet else self_test_report(found))
    return ExitCode.NOT_ACCEPTED if found.accepted_wrongly else ExitCode.ACCEPTED


def _camera(path: Path) -> Camera:
    from ladarreg_core.camera import require_pinhole
    from ladarreg_core.formats.cameras.camera_file import read_camera

    return require_pinhole(read_camera(path), "The self-test")
