"""`ladarreg targets SCAN TARGETS -o OUT`."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ..exit_codes import ExitCode
from ..progress_bar import progress_bar

EXAMPLES = (
    "ladarreg targets hall.e57 spheres.csv --radius .0725 -o station",
    "# flat black-and-white targets of 15 cm, found if no cells on them are given:",
    "ladarreg targets hall.e57 plates.csv --side .15 -o station",
    "# coordinates by a total station that is good to 2 mm:",
    "ladarreg targets hall.npz spheres.csv --radius .1 --sigma .002 -o station",
)


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Arguments of `targets`."""

    scan: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SCAN")]
    """The scan."""
    targets: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="TARGETS")]
    """CSV with a line a target: name, row and column of a cell on it, and its surveyed x, y, z in metres. Without row
    and column the targets are found, and named by their distances."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT")]
    """Output folder; an existing one is refused, but see --force."""
    radius: Annotated[float | None, tyro.conf.arg(metavar="M")] = None
    """Radius of the spheres, where the file has no column radius_m."""
    side: Annotated[float | None, tyro.conf.arg(metavar="M")] = None
    """Side of flat black-and-white targets, all four quadrants together, where the file has no column side_m."""
    sigma: Annotated[float, tyro.conf.arg(metavar="M")] = 0.001
    """Standard deviation of the surveyed coordinates."""
    force: bool = False
    """Replace OUT if it contains an earlier statement and nothing else; any other folder is never touched."""
    json: bool = False
    """Print the statement as JSON, and nothing else, on stdout; errors, too."""
    quiet: bool = False
    """Print no progress."""
    debug: bool = False
    """Print a log, and a traceback on failure."""


def run(arguments: Arguments) -> ExitCode:
    """Fit the targets, place the scanner, and write the statement."""
    from ladarreg_core.errors import OptionError
    from ladarreg_core.export.targets.folder import check_folder
    from ladarreg_core.formats import read_scan
    from ladarreg_core.formats.documents.targets_file import read_targets
    from ladarreg_core.outputs.target_statement import write_target_statement
    from ladarreg_core.registration.stations.target_names import locate_targets
    from ladarreg_core.registration.stations.target_pose import register_targets

    started = time.perf_counter()
    files = [arguments.scan, arguments.targets]
    check_folder(arguments.out, force=arguments.force, inputs=files)
    entries = read_targets(arguments.targets)
    if arguments.radius is not None and arguments.side is not None:
        raise OptionError("spheres and flat targets in one file need a column radius_m or side_m; give one option only")
    sizes = {one.name: one.size_or(radius_m=arguments.radius, side_m=arguments.side) for one in entries}
    unknown = [name for name, size in sizes.items() if not size]
    if unknown:
        raise OptionError(
            f"the size of {', '.join(unknown[:5])} is not known; give it with --radius, or --side for flat targets"
        )
    with progress_bar(quiet=arguments.quiet or arguments.json) as bar:
        scan = read_scan(arguments.scan, report=bar.loading)
        picks, coordinates = ({one.name: getattr(one, field) for one in entries} for field in ("pick", "coordinates"))
        targets = locate_targets(scan, picks, sizes, coordinates, sigma_m=arguments.sigma)
        found = register_targets(targets, coordinates, sigma_m=arguments.sigma)
        details = {"scan": arguments.scan.name, "coordinates_sigma_m": arguments.sigma}
        document = write_target_statement(
            arguments.out, found, targets, details=details, inputs=files, force=arguments.force
        )
    if arguments.json:
        from ..json_output import print_json

        print_json(document)
        return ExitCode.ACCEPTED
    from ladarreg_core.foundations.formatting import format_angle, format_length

    position_m, angle_rad = found.sigmas
    x, y, z = found.world_from_scanner.translation
    print(f"Scanner  at {x:.4f}, {y:.4f}, {z:.4f} m, within {format_length(position_m)}, {format_angle(angle_rad)}")
    for one in document["targets"]:
        dx, dy, dz = (1000 * value for value in one["residual_m"])
        print(f"Target   {one['name']}: {dx:+.1f} {dy:+.1f} {dz:+.1f} mm{'' if one['used'] else ', left out'}")
    for name in (name for name in coordinates if name not in targets):
        print(f"Target   {name}: not found in the scan")
    print(f"Fit      chi squared {found.chi2:.1f} at {found.dof} degrees of freedom")
    print(f"Wrote    targets.json, targets.csv in {arguments.out}")
    print(f"Took     {time.perf_counter() - started:.1f} s")
    return ExitCode.ACCEPTED
