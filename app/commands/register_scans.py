"""`ladarreg register-scans SCAN SCAN ... -o OUT`."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, TypeAlias

import tyro

from ..exit_codes import ExitCode
from ..messages import one_line
from ..progress_bar import progress_bar

EXAMPLES = (
    "ladarreg register-scans hall.e57 office.e57 -o stations",
    "# all scans of one file, the second of them held in place:",
    "ladarreg register-scans survey.e57 -o stations --fixed 1",
    "# judge the poses in the files as they are, or ignore them:",
    "ladarreg register-scans survey.e57 -o stations --poses keep",
    "ladarreg register-scans a.npz b.npz c.npz -o stations --poses search",
)
_Paths: TypeAlias = list[Path]


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Arguments of `register-scans`."""

    scans: Annotated[tyro.conf.Positional[_Paths], tyro.conf.arg(metavar="SCAN")]
    """Scans of several stations; a file that contains several gives all of them."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT")]
    """Output folder; an existing one is refused, but see --force."""
    fixed: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Number of the scan that keeps its pose, from 0; the others are moved to it."""
    poses: Literal["keep", "refine", "search"] = "refine"
    """What the poses in the files are used for. keep: judge them as they are; refine: compare only what is within a
    metre of them; search: ignore them. How well the scans agree at these poses is stated in any case."""
    seed: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Random seed."""
    force: bool = False
    """Replace OUT if it contains earlier stations and nothing else; any other folder is never touched."""
    json: bool = False
    """Print stations.json, and nothing else, on stdout; errors, too."""
    quiet: bool = False
    """Print no progress."""
    debug: bool = False
    """Print a log, and a traceback on failure."""


def run(arguments: Arguments) -> ExitCode:
    """Register the scans and write `stations.json` and the scans with their poses."""
    from ladarreg_core.export.outputs.station_folder import read_stations, write_stations
    from ladarreg_core.export.targets.folder import check_folder
    from ladarreg_core.formats.documents.stations_info import station_lines
    from ladarreg_core.registration.stations.registration import register_scans
    from ladarreg_core.storage.manifest import visible_files

    started = time.perf_counter()
    check_folder(arguments.out, force=arguments.force, inputs=arguments.scans)
    with progress_bar(quiet=arguments.quiet or arguments.json) as bar:
        stations = read_stations(arguments.scans, report=bar.progress)
        network = register_scans(
            [one.scan for one in stations], fixed=arguments.fixed, poses=arguments.poses, seed=arguments.seed,
            report=bar.progress,
        )  # fmt: skip
        fields = write_stations(arguments.out, network, stations, force=arguments.force, report=bar.progress)
    code = ExitCode.ACCEPTED if network.accepted else ExitCode.NOT_ACCEPTED
    if arguments.json:
        from ..json_output import print_json

        files = visible_files(arguments.out)
        print_json({**fields, "output": {"folder": os.path.abspath(arguments.out), "files": files}})
        return code
    for name, value in station_lines(fields):
        print(f"{name.capitalize():<10} {one_line(value)}")
    print(f"Wrote      {', '.join(visible_files(arguments.out))} in {arguments.out}")
    print(f"Took       {time.perf_counter() - started:.1f} s")
    return code
