"""`ladarreg rectify RESULT -o OUT`."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeAlias

import tyro

from ..exit_codes import ExitCode
from ..inputs import pixels_of, read_on_one_scan
from ..progress_bar import progress_bar

if TYPE_CHECKING:
    from ladarreg_core.export.registered_scan import RegisteredScan
    from ladarreg_core.inspection.measuring.developable import Cylinder, Plane

EXAMPLES = (
    "# the wall around a pixel of the photo:",
    "ladarreg rectify results --at 812,400 --mm-per-pixel 2 -o wall",
    "# the plane of three points; a pipe, unrolled; a plan at 1.2 m:",
    "ladarreg rectify results --at 812,400 --at 90,80 --at 700,90 -o facade",
    "ladarreg rectify results --at 812,400 --surface pipe -o pipe",
    "ladarreg rectify results --height 1.2 --mm-per-pixel 10 -o plan",
)
_PLAN_BELOW_M = 2.0
_BESIDE_M = 0.5
_PIPE_RADIUS_M = 0.3
_Paths: TypeAlias = list[Path]
_Names: TypeAlias = list[str]


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Arguments of `rectify`."""

    results: Annotated[tyro.conf.Positional[_Paths], tyro.conf.arg(metavar="RESULT")]
    """Folder of results, or several on the same scan."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT")]
    """Output folder; an existing one is refused, but see --force."""
    at: Annotated[tyro.conf.UseAppendAction[_Names], tyro.conf.arg(metavar="U,V")] = field(default_factory=list)
    """A pixel of the (first) photo: one, around which the surface is fitted, or three of a plane. Repeatable."""
    height: Annotated[float | None, tyro.conf.arg(metavar="M")] = None
    """Instead of pixels: a plan at this height of the frame, seen from above, with its section as DXF."""
    surface: Literal["plane", "pipe"] = "plane"
    """What is fitted; pipe: a cylinder, which is unrolled."""
    radius: Annotated[float | None, tyro.conf.arg(metavar="M")] = None
    """Radius around the pixel in which it is fitted (.5; of a pipe .3)."""
    mm_per_pixel: Annotated[float, tyro.conf.arg(metavar="MM")] = 5.0
    """Scale of the view."""
    below: Annotated[float | None, tyro.conf.arg(metavar="M")] = None
    """How far behind the surface, or below the plan, is shown (.5; of a plan 2)."""
    above: Annotated[float | None, tyro.conf.arg(metavar="M")] = None
    """How far before the surface, or above the plan, is shown (.5; of a plan 0)."""
    frame: Literal["scanner", "world"] = "scanner"
    """Frame of the height, the section and the coordinates of a plan; world: that of the survey."""
    crs: Annotated[str | None, tyro.conf.arg(metavar="CODE")] = None
    """Coordinate reference system of a plan in the world, such as EPSG:25832, stated in its files."""
    scan: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """The scan's file, if it is not found beside the results."""
    root: Annotated[tyro.conf.UseAppendAction[_Paths], tyro.conf.arg(metavar="FOLDER")] = field(default_factory=list)
    """Folder where the scan and the photos are looked for, too. Repeatable."""
    trust_edited: bool = False
    """Go on with results that were changed after they were written: given, not verified."""
    force: bool = False
    """Replace OUT if it contains an earlier view and nothing else; any other folder is never touched."""
    quiet: bool = False
    """Print no progress."""
    debug: bool = False
    """Print a log, and a traceback on failure."""


def run(arguments: Arguments) -> ExitCode:
    """Make the view and write it."""
    from ladarreg_core.errors import OptionError
    from ladarreg_core.export.output_frame import OutputFrame
    from ladarreg_core.export.targets.folder import check_folder
    from ladarreg_core.inspection.measuring.rectified import rectify
    from ladarreg_core.inspection.measuring.section import section
    from ladarreg_core.inspection.measuring.view_files import write_view

    started = time.perf_counter()
    if (arguments.height is None) == (not arguments.at):
        raise OptionError("a surface is needed: pixels with --at, or a plan with --height; give one of both")
    if arguments.at and len(arguments.at) not in ((1, 3) if arguments.surface == "plane" else (1,)):
        wanted = "one, or three of a plane" if arguments.surface == "plane" else "one, on the pipe"
        raise OptionError(f"--at is given {len(arguments.at)} times; give {wanted}")
    check_folder(arguments.out, force=arguments.force, inputs=arguments.results)
    with progress_bar(quiet=arguments.quiet) as bar:
        opened = read_on_one_scan(arguments, bar)
        world = None if arguments.frame == "scanner" else OutputFrame.of(opened.scan, "world").world_from_scanner
        from ladarreg_core.inspection.measuring.developable import Plane

        plan = None if arguments.height is None else Plane.level(arguments.height, world_from_scanner=world)
        surface = plan or _surface(arguments, opened)
        view = rectify(
            opened if opened.photos else opened.scan,
            surface,
            mm_per_pixel=arguments.mm_per_pixel,
            below_m=_given(arguments.below, _BESIDE_M if plan is None else _PLAN_BELOW_M),
            above_m=_given(arguments.above, _BESIDE_M if plan is None else 0.0),
            report=bar.progress,
        )
        lines = [] if plan is None else section(opened.scan, plan)
        write_view(
            arguments.out, view, lines=lines, world_from_scanner=world, crs=arguments.crs, marks=opened.marks,
            inputs=arguments.results, force=arguments.force, report=bar.progress,
        )  # fmt: skip
    from ladarreg_core.storage.manifest import visible_files

    height, width = view.known.shape
    print(f"View     {width} x {height} pixels of {view.mm_per_pixel:g} mm; {view.known.mean():.0%} of it is shown")
    print(f"Error    {view.described_error}")
    for mark in opened.marks:
        print(f"Pose     {mark}")
    print(f"Wrote    {', '.join(visible_files(arguments.out))} in {arguments.out}")
    print(f"Took     {time.perf_counter() - started:.1f} s")
    return ExitCode.ACCEPTED


def _given(value: float | None, default: float) -> float:
    return default if value is None else value


def _surface(arguments: Arguments, opened: RegisteredScan) -> Plane | Cylinder:
    """Return the surface of the pixels that were given."""
    from ladarreg_core.errors import DegenerateGeometryError, OptionError
    from ladarreg_core.inspection.measuring.developable import Cylinder, Plane
    from ladarreg_core.inspection.measuring.points import MeasuredPoints

    if not opened.photos:
        raise OptionError("the pose of the photo was refused, so its pixels have no place; use --height")
    one = opened.photos[0]
    picked = MeasuredPoints.of_photo(opened.scan, one.registration, pixels_of(arguments.at), name=one.photo.name)
    refused = [f"{name} {why}" for name, why in zip(picked.names, picked.refusals, strict=True) if why]
    if refused:
        raise DegenerateGeometryError(refused[0])
    if len(picked) == 3:
        return Plane.through(picked.xyz)
    if arguments.surface == "pipe":
        return Cylinder.fitted(opened.scan, picked.xyz[0], radius_m=_given(arguments.radius, _PIPE_RADIUS_M))
    return Plane.fitted(opened.scan, picked.xyz[0], radius_m=_given(arguments.radius, _BESIDE_M))
