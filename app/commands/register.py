"""`ladarreg register SCAN PHOTO -o OUT`."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeVar

import tyro

from app.exit_codes import ExitCode
from app.step_bar import StepBar, step_bar
from app.wording import report, verdict

if TYPE_CHECKING:
    from ladarreg_core.matches import Pick
    from ladarreg_core.photo import Photo
    from ladarreg_core.results import Registration
    from ladarreg_core.scan import Scan

T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """What `register` is told."""

    scan: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SCAN")]
    """Scan: E57, PCD, NPZ or a descriptor JSON."""
    photo: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="PHOTO")]
    """Photograph: JPEG, PNG, TIFF."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT")]
    """Folder to write; it must not exist, see --force."""
    method: Literal["auto", "thesis", "manual"] = "auto"
    """How to register. With --matches: manual."""
    matches: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Matches put down by hand: JSON, or CSV of points."""
    initial: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """A first pose to try: a pose JSON or an earlier registration.json."""
    camera: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """The photo's camera: JSON, OpenCV YAML or ROS camera_info."""
    focal_px: Annotated[float | None, tyro.conf.arg(metavar="PX")] = None
    """The photo's focal length, pixels, where there is no camera file."""
    focal_mm: Annotated[float | None, tyro.conf.arg(metavar="MM")] = None
    """The photo's focal length, mm; needs --sensor-mm."""
    sensor_mm: Annotated[float | None, tyro.conf.arg(metavar="MM")] = None
    """The sensor's width, mm."""
    scan_index: int = 0
    """Which scan of a file with several."""
    seed: int = 0
    """Of every random draw: the same seed, the same answer."""
    force: bool = False
    """Replace OUT if it exists."""
    quiet: bool = False
    """No progress, and the verdict in one line."""
    debug: bool = False
    """Log, and a trace back where something fails."""


def run(arguments: Arguments) -> ExitCode:
    """Read, register, export, and tell the verdict."""
    from ladarreg_core.export.folder import check_folder

    started = time.perf_counter()
    check_folder(arguments.out, force=arguments.force)
    with step_bar(quiet=arguments.quiet) as bar:
        scan, photo = _read(arguments, bar)
        result = _register(arguments, scan, photo, bar)
        names = _export(arguments, result, scan, photo, bar)
    if arguments.quiet:
        print(verdict(result))
    else:
        for note in (*scan.notes, *photo.notes):
            print(f"Note     {note}")
        print(report(result))
        print(f"Wrote    {', '.join(names)} in {arguments.out}")
        print(f"Took     {time.perf_counter() - started:.1f} s")
    return ExitCode.ACCEPTED if result.accepted else ExitCode.NOT_ACCEPTED


def _read(arguments: Arguments, bar: StepBar) -> tuple[Scan, Photo]:
    import ladarreg_core as lr

    scan = _timed("read scan", bar, lambda: lr.read_scan(arguments.scan, scan_index=arguments.scan_index))
    photo = _timed(
        "read photo",
        bar,
        lambda: lr.read_photo(
            arguments.photo,
            camera=arguments.camera,
            focal_px=arguments.focal_px,
            focal_mm=arguments.focal_mm,
            sensor_mm=arguments.sensor_mm,
        ),
    )
    return scan, photo


def _register(arguments: Arguments, scan: Scan, photo: Photo, bar: StepBar) -> Registration:
    import ladarreg_core as lr
    from ladarreg_core.formats.matches_file import read_matches
    from ladarreg_core.formats.pose_file import read_pose
    from ladarreg_core.register import RegisterOptions

    picks: list[Pick] | None = read_matches(arguments.matches, scan) if arguments.matches else None
    initial = read_pose(arguments.initial) if arguments.initial else None
    method = "manual" if picks is not None and arguments.method == "auto" else arguments.method
    return lr.register(
        scan,
        photo,
        method=method,
        picks=picks,
        initial=initial,
        options=RegisterOptions(seed=arguments.seed),
        report=bar.step,
    )


def _export(arguments: Arguments, result: Registration, scan: Scan, photo: Photo, bar: StepBar) -> list[str]:
    from ladarreg_core.export.folder import export_registration

    given = (arguments.scan, arguments.photo, arguments.camera, arguments.matches, arguments.initial)
    export_registration(
        arguments.out,
        result,
        scan,
        photo,
        inputs=[path for path in given if path is not None],
        force=arguments.force,
        report=bar.progress,
    )
    return sorted(path.name for path in arguments.out.iterdir())


def _timed(name: str, bar: StepBar, work: Callable[[], T]) -> T:
    from ladarreg_core.progress import Step

    started = time.perf_counter()
    result = work()
    bar.step(Step(name, time.perf_counter() - started))
    return result
