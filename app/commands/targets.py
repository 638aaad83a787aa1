"""`ladarreg targets SCAN ... TARGETS -o OUT`."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

import tyro

from ..exit_codes import ExitCode
from ..progress_bar import progress_bar

if TYPE_CHECKING:
    from ladarreg_core.formats.documents.targets_file import TargetEntry

EXAMPLES = (
    "ladarreg targets hall.e57 spheres.csv --radius .0725 -o station",
    "# flat black-and-white targets of 15 cm, found if no cells on them are given:",
    "ladarreg targets hall.e57 plates.csv --side .15 -o station",
    "# coordinates by a total station that is good to 2 mm:",
    "ladarreg targets hall.npz spheres.csv --radius .1 --sigma .002 -o station",
    "# several scans, joined by the spheres that they share:",
    "ladarreg targets hall.e57 attic.e57 --radius .0725 -o stations",
    "ladarreg targets hall.e57 attic.e57 xyz.csv --radius .0725 -o stations",
    "# scanners that were levelled to .02 deg:",
    "ladarreg targets hall.e57 attic.e57 --radius .0725 --level-sigma .02 -o out",
)
_Paths: TypeAlias = list[Path]


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Arguments of `targets`."""

    files: Annotated[tyro.conf.Positional[_Paths], tyro.conf.arg(metavar="FILE")]
    """The scan, or several that share targets, and a CSV with a line a target: name, row and column of a cell on it (of
    several scans also its scan), and its surveyed x, y, z in metres. Without row and column the targets are found, and
    named by their distances; several scans need no coordinates, nor any CSV."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT")]
    """Output folder; an existing one is refused, but see --force."""
    radius: Annotated[float | None, tyro.conf.arg(metavar="M")] = None
    """Radius of the spheres, where the file has no column radius_m."""
    side: Annotated[float | None, tyro.conf.arg(metavar="M")] = None
    """Side of flat black-and-white targets, all four quadrants together, where the file has no column side_m."""
    sigma: Annotated[float, tyro.conf.arg(metavar="M")] = 0.001
    """Standard deviation of the surveyed coordinates."""
    level_sigma: Annotated[float | None, tyro.conf.arg(metavar="DEG")] = None
    """Standard deviation of the level, in degrees: several scans are upright by an inclinometer, Z up but for that.
    Default: nothing is known of it."""
    force: bool = False
    """Replace OUT if it contains an earlier statement and nothing else; any other folder is never touched."""
    json: bool = False
    """Print the statement as JSON, and nothing else, on stdout; errors, too."""
    quiet: bool = False
    """Print no progress."""
    debug: bool = False
    """Print a log, and a traceback on failure."""


def run(arguments: Arguments) -> ExitCode:
    """Fit or find the targets, place the scanners, and write the statement."""
    from ladarreg_core.errors import OptionError
    from ladarreg_core.export.targets.folder import check_folder
    from ladarreg_core.formats.documents.targets_file import is_targets_file, read_targets

    started = time.perf_counter()
    check_folder(arguments.out, force=arguments.force, inputs=arguments.files)
    tables = [path for path in arguments.files if is_targets_file(path)]
    scans = [path for path in arguments.files if path not in tables]
    if len(tables) > 1 or not scans:
        raise OptionError(
            f"{len(scans)} scans and {len(tables)} files of targets are given; give one scan or more, and at most one "
            "file of targets"
        )
    entries = read_targets(tables[0]) if tables else []
    if entries and arguments.radius is not None and arguments.side is not None:
        raise OptionError("spheres and flat targets in one file need a column radius_m or side_m; give one option only")
    sizes = {one.name: one.size_or(radius_m=arguments.radius, side_m=arguments.side) for one in entries}
    unknown = [name for name, size in sizes.items() if not size]
    if unknown:
        raise OptionError(
            f"the size of {', '.join(unknown[:5])} is not known; give it with --radius, or --side for flat targets"
        )
    is_single = _is_single(scans, entries)
    if is_single and arguments.level_sigma is not None:
        raise OptionError("--level-sigma is for several scans; of one, give the coordinates of its targets alone")
    place = _place_one if is_single else _place_several
    document = place(arguments, scans, entries, sizes)
    if arguments.json:
        from ..json_output import print_json

        print_json(document)
    else:
        print(f"Took     {time.perf_counter() - started:.1f} s")
    return ExitCode.ACCEPTED


def _is_single(scans: Sequence[Path], entries: Sequence[TargetEntry]) -> bool:
    """Return whether one scan is meant: without a column that names scans, picks are in the first of a file."""
    from ladarreg_core.export.outputs.station_folder import count_scans

    if len(scans) > 1 or not entries or entries[0].scan is not None:
        return False
    return entries[0].pick is not None or count_scans(scans[0]) == 1


def _place_one(
    arguments: Arguments, scans: Sequence[Path], entries: Sequence[TargetEntry], sizes: dict[str, dict[str, float]]
) -> dict[str, Any]:
    from ladarreg_core.export.outputs.target_statement import write_target_statement
    from ladarreg_core.formats import read_scan
    from ladarreg_core.formats.documents.targets_file import surveyed_coordinates
    from ladarreg_core.foundations.formatting import format_angle, format_length
    from ladarreg_core.registration.stations.target_names import locate_targets
    from ladarreg_core.registration.stations.target_pose import register_targets

    with progress_bar(quiet=arguments.quiet or arguments.json) as bar:
        scan = read_scan(scans[0], report=bar.loading)
        coordinates = surveyed_coordinates(entries)
        picks = {one.name: one.pick for one in entries}
        targets = locate_targets(scan, picks, sizes, coordinates, sigma_m=arguments.sigma)
        found = register_targets(targets, coordinates, sigma_m=arguments.sigma)
        details = {"scan": scans[0].name, "coordinates_sigma_m": arguments.sigma}
        document = write_target_statement(
            arguments.out, found, targets, details=details, inputs=arguments.files, force=arguments.force
        )
    if arguments.json:
        return document
    position_m, angle_rad = found.sigmas
    x, y, z = found.world_from_scanner.translation
    print(f"Scanner  at {x:.4f}, {y:.4f}, {z:.4f} m, within {format_length(position_m)}, {format_angle(angle_rad)}")
    _print_residuals("", document["targets"])
    for name in (name for name in coordinates if name not in targets):
        print(f"Target   {name}: not found in the scan")
    print(f"Fit      chi squared {found.chi2:.1f} at {found.dof} degrees of freedom")
    print(f"Wrote    targets.json, targets.csv in {arguments.out}")
    return document


def _place_several(
    arguments: Arguments, scans: Sequence[Path], entries: Sequence[TargetEntry], sizes: dict[str, dict[str, float]]
) -> dict[str, Any]:
    from ladarreg_core.errors import OptionError
    from ladarreg_core.export.outputs.station_folder import read_stations
    from ladarreg_core.export.outputs.target_statement import write_network_statement
    from ladarreg_core.formats.documents.targets_file import surveyed_coordinates
    from ladarreg_core.foundations.formatting import format_angle, format_length
    from ladarreg_core.registration.stations.target_names import locate_in_scans
    from ladarreg_core.registration.stations.target_pose import register_targets
    from ladarreg_core.storage.manifest import visible_files

    given = {"radius_m": arguments.radius, "side_m": arguments.side}
    looked_for = [{name: size} for name, size in given.items() if size is not None]
    looked_for += [size for size in sizes.values() if size not in looked_for]
    if not looked_for:
        raise OptionError("the size of the targets is not known; give it with --radius, or --side for flat targets")
    with progress_bar(quiet=arguments.quiet or arguments.json) as bar:
        stations = read_stations(scans, report=bar.progress)
        by_name = {one.scan.name: one.scan for one in stations}
        picks: dict[str, dict[str, tuple[int, int]]] = {}
        for entry in (one for one in entries if one.pick is not None):
            if entry.scan not in by_name or entry.pick is None:
                where = "a scan that is not named" if entry.scan is None else f"scan {entry.scan}"
                raise OptionError(
                    f"target {entry.name} was picked in {where}; name the scans in a column scan: {', '.join(by_name)}"
                )
            picks.setdefault(entry.scan, {})[entry.name] = entry.pick
        coordinates = surveyed_coordinates(entries)
        targets = locate_in_scans(
            by_name, picks, sizes, coordinates, looked_for=looked_for, sigma_m=arguments.sigma, report=bar.progress
        )
        levels = {} if arguments.level_sigma is None else dict.fromkeys(targets, arguments.level_sigma)
        found = register_targets(targets, coordinates, sigma_m=arguments.sigma, levels=levels)
        details = {"coordinates_sigma_m": arguments.sigma} if coordinates else {}
        details |= {} if arguments.level_sigma is None else {"level_sigma_deg": arguments.level_sigma}
        document = write_network_statement(
            arguments.out, found, targets, stations, details=details, force=arguments.force, report=bar.progress
        )
    if arguments.json:
        return document
    for reason in found.reasons:
        print(f"World    {reason}")
    for one, scan in zip(document["stations"], document["targets"]["scans"], strict=True):
        x, y, z = (row[3] for row in one["world_from_scanner"][:3])
        position_m, angle_rad = math.hypot(*one["sigma_mm"]) / 1000, math.radians(math.hypot(*one["sigma_deg"]))
        within = "fixed" if one["state"] == "fixed" else f"{format_length(position_m)}, {format_angle(angle_rad)}"
        print(f"Scanner  {one['name']} at {x:.4f}, {y:.4f}, {z:.4f} m, {within}")
        _print_residuals(f"{one['name']}, ", scan["targets"])
    _print_residuals("coordinates, ", document["targets"]["coordinates"])
    print(f"Fit      chi squared {found.chi2:.1f} at {found.dof} degrees of freedom")
    print(f"Wrote    {', '.join(visible_files(arguments.out))} in {arguments.out}")
    return document


def _print_residuals(where: str, targets: Sequence[Mapping[str, Any]]) -> None:
    for one in targets:
        dx, dy, dz = (1000 * value for value in one["residual_m"])
        print(f"Target   {where}{one['name']}: {dx:+.1f} {dy:+.1f} {dz:+.1f} mm{'' if one['used'] else ', left out'}")
