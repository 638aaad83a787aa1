"""What the commands that register take from their words: the files to read, and how to read them."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import tyro

from .progress_bar import StepBar

if TYPE_CHECKING:
    from ladarreg_core.frames import Rigid
    from ladarreg_core.matches import Pick
    from ladarreg_core.photo import Photo
    from ladarreg_core.scan import Scan

T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class InputArguments:
    """Scan, photograph and what is known of them; where to write."""

    scan: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SCAN")]
    """Scan: E57, PCD, NPZ or a descriptor JSON."""
    photo: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="PHOTO")]
    """Photograph: JPEG, PNG, TIFF."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT")]
    """Folder to write; one that exists is refused, but see --force."""
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
    """Replace OUT if it holds results of an earlier run and nothing else; any other folder is left as it is."""
    quiet: bool = False
    """No progress, and the verdict in one line."""
    debug: bool = False
    """Log, and a trace back where something fails."""


def read_inputs(arguments: InputArguments, bar: StepBar) -> tuple[Scan, Photo]:
    """Read the scan and the photograph, and tell each as a step."""
    import ladarreg_core as lr

    scan = timed("read scan", bar, lambda: lr.read_scan(arguments.scan, scan_index=arguments.scan_index))
    photo = timed(
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


def read_start(arguments: InputArguments, scan: Scan) -> tuple[list[Pick] | None, Rigid | None]:
    """Read the matches and the first pose, where there are any."""
    from ladarreg_core.formats.matches_file import read_matches
    from ladarreg_core.formats.pose_file import read_pose

    picks = read_matches(arguments.matches, scan) if arguments.matches else None
    initial = read_pose(arguments.initial) if arguments.initial else None
    return picks, initial


def input_files(arguments: InputArguments) -> list[Path]:
    """Return every file that was given."""
    given = (arguments.scan, arguments.photo, arguments.camera, arguments.matches, arguments.initial)
    return [path for path in given if path is not None]


def timed(name: str, bar: StepBar, work: Callable[[], T]) -> T:
    """Do the work and tell it as a step."""
    from ladarreg_core.progress import Step

    started = time.perf_counter()
    result = work()
    bar.step(Step(name, time.perf_counter() - started))
    return result


def print_notes(scan: Scan, photo: Photo) -> None:
    """Print what an operator should know of the files."""
    for note in (*scan.notes, *photo.notes):
        print(f"Note     {note}")
