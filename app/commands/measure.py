"""`ladarreg measure RESULT --points FILE`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeAlias

import tyro

from ..exit_codes import ExitCode
from ..inputs import pixels_of, read_on_one_scan
from ..progress_bar import progress_bar

if TYPE_CHECKING:
    from ladarreg_core.formats.documents.places_file import Place

EXAMPLES = (
    "ladarreg measure results --kind distance --at 812,400 --at 1200,402",
    "# many, each line of the file a point, into a drawing:",
    "ladarreg measure results --points points.csv -o plan.dxf",
    "ladarreg measure results --points corners.csv --kind area --json",
)
_Paths: TypeAlias = list[Path]
_Names: TypeAlias = list[str]


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Arguments of `measure`."""

    results: Annotated[tyro.conf.Positional[_Paths], tyro.conf.arg(metavar="RESULT")]
    """Folder of results, or several on the same scan."""
    points: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """CSV of points: u,v of a photo, row,column of the scan, or x,y,z; and, if wanted, the columns measurement (points
    of one name belong together), kind and photo."""
    at: Annotated[tyro.conf.UseAppendAction[_Names], tyro.conf.arg(metavar="U,V")] = field(default_factory=list)
    """A pixel of the photo, instead of a file. Repeatable."""
    kind: Literal["point", "distance", "polyline", "angle", "area", "height"] | None = None
    """What is measured: the coordinates of points; a distance; the length of a polyline; the angle at the second of
    three points; the area of a polygon; the height of the first point above the plane of the others."""
    sigma_px: Annotated[float, tyro.conf.arg(metavar="PX")] = 0.5
    """Standard deviation of picked pixels and cells along each axis."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FILE")] = None
    """Write the list: .csv, .json, .geojson or .dxf; an existing file is never replaced."""
    frame: Literal["scanner", "world"] = "scanner"
    """Frame of coordinates that are given and written; world: that of the survey."""
    crs: Annotated[str | None, tyro.conf.arg(metavar="CODE")] = None
    """Coordinate reference system of the world, such as EPSG:25832, stated in files."""
    scan: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """The scan's file, if it is not found beside the results."""
    root: Annotated[tyro.conf.UseAppendAction[_Paths], tyro.conf.arg(metavar="FOLDER")] = field(default_factory=list)
    """Folder where the scan and the photos are looked for, too. Repeatable."""
    trust_edited: bool = False
    """Go on with results that were changed after they were written: given, not verified."""
    json: bool = False
    """Print the measurements as JSON, and nothing else, on stdout; errors, too."""
    quiet: bool = False
    """Print no progress."""
    debug: bool = False
    """Print a log, and a traceback on failure."""


def run(arguments: Arguments) -> ExitCode:
    """Measure, print the list, and write it where asked."""
    from ladarreg_core.errors import OptionError
    from ladarreg_core.export.output_frame import OutputFrame
    from ladarreg_core.inspection.measuring.measurement_list import check_target, measure_places, write_measurements

    places = _places(arguments)
    if arguments.out is not None:
        check_target(arguments.out, frame=arguments.frame, crs=arguments.crs)
    elif arguments.crs is not None:
        raise OptionError("--crs is stated in files; give one with -o")
    with progress_bar(quiet=arguments.quiet or arguments.json) as bar:
        opened = read_on_one_scan(arguments, bar)
        frame = OutputFrame.of(opened.scan, arguments.frame)
        found = measure_places(
            opened.scan,
            {one.photo.name: one.registration for one in (*opened.photos, *opened.refused)},
            places,
            kind=arguments.kind,
            sigma_px=arguments.sigma_px,
            world_from_scanner=None if arguments.frame == "scanner" else frame.world_from_scanner,
        )
        if arguments.out is not None:
            write_measurements(arguments.out, found, frame=arguments.frame, crs=arguments.crs)
    if arguments.json:
        from ..json_output import print_json

        print_json({"frame": arguments.frame, "measurements": [one.as_fields() for one in found]})
    else:
        width = max(len(one.name) for one in found)
        for one in found:
            if one.measurement is None:
                print(f"{one.name:<{width}}  refused: {one.refusal}")
                continue
            print(f"{one.name:<{width}}  {one.measurement.described}")
            for flag in one.measurement.flags:
                print(f"{'':<{width}}  note: {flag}")
        if arguments.out is not None:
            print(f"Wrote {arguments.out}")
    refused = any(one.measurement is None for one in found)
    return ExitCode.NOT_ACCEPTED if refused else ExitCode.ACCEPTED


def _places(arguments: Arguments) -> list[Place]:
    """Return the points that were given.

    Raises:
        OptionError: unless they were given in one way.
        FormatError: as `read_places`.
    """
    from ladarreg_core.errors import OptionError
    from ladarreg_core.formats.documents.places_file import Place, read_places

    if (arguments.points is None) == (not arguments.at):
        raise OptionError("points are needed: pixels with --at, or a file with --points; give one of both")
    if arguments.points is not None:
        return read_places(arguments.points)
    return [Place(at, "photo") for at in pixels_of(arguments.at)]
