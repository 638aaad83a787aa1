"""`ladarreg change BEFORE AFTER -o OUT`."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from ..exit_codes import ExitCode
from ..progress_bar import progress_bar

EXAMPLES = (
    "ladarreg change may.e57 november.e57 -o change",
    "# scans that are in one frame already, finer:",
    "ladarreg change may.npz november.npz --poses keep --spacing .05 -o change",
)


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Arguments of `change`."""

    before: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="BEFORE")]
    """The first scan."""
    after: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="AFTER")]
    """The second scan."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT")]
    """Output folder; an existing one is refused, but see --force."""
    poses: Literal["register", "keep"] = "register"
    """register: the second scan is registered to the first, and its uncertainty counts; keep: the poses in the files
    are exact, or both scans are in one frame."""
    spacing: Annotated[float, tyro.conf.arg(metavar="M")] = 0.1
    """Distance between the points that are compared."""
    radius: Annotated[float, tyro.conf.arg(metavar="M")] = 0.1
    """Radius of the surface around each that is compared; changes that are smaller are averaged out."""
    reach: Annotated[float, tyro.conf.arg(metavar="M")] = 0.5
    """Largest distance that is looked for."""
    seed: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Random seed."""
    force: bool = False
    """Replace OUT if it contains an earlier comparison and nothing else; any other folder is never touched."""
    json: bool = False
    """Print the summary as JSON, and nothing else, on stdout; errors, too."""
    quiet: bool = False
    """Print no progress."""
    debug: bool = False
    """Print a log, and a traceback on failure."""


def run(arguments: Arguments) -> ExitCode:
    """Register the second scan to the first, compare, and write the result."""
    from ladarreg_core.export.targets.folder import check_folder
    from ladarreg_core.formats import read_scan
    from ladarreg_core.inspection.measuring.change import change, stated_pose
    from ladarreg_core.inspection.measuring.change_files import write_change
    from ladarreg_core.registration.stations.registration import register_scans

    started = time.perf_counter()
    files = [arguments.before, arguments.after]
    covariance: Any = None
    details: dict[str, Any] = {"poses": arguments.poses}
    check_folder(arguments.out, force=arguments.force, inputs=files)
    with progress_bar(quiet=arguments.quiet or arguments.json) as bar:
        before, after = (read_scan(path, report=bar.loading) for path in files)
        if arguments.poses == "keep":
            pose = stated_pose(before, after)
        else:
            pair = register_scans([before, after], seed=arguments.seed, report=bar.progress).pairs[0]
            if not pair.verified:
                _refuse(arguments, pair.reasons)
                return ExitCode.NOT_ACCEPTED
            pose, covariance = pair.first_from_second, pair.covariance
            details |= {"covariance": covariance.tolist(), "sigma_mm": pair.sigma_mm}
        found = change(
            before, after, before_from_after=pose, covariance=covariance, spacing_m=arguments.spacing,
            radius_m=arguments.radius, reach_m=arguments.reach, report=bar.progress,
        )  # fmt: skip
        write_change(
            arguments.out, found, before, before_from_after=pose, details=details, inputs=files, force=arguments.force,
        )  # fmt: skip
    fields = found.as_fields()
    if arguments.json:
        from ..json_output import print_json

        print_json({**fields, **details})
        return ExitCode.ACCEPTED
    from ladarreg_core.foundations.formatting import format_length

    share = f"{fields['significant_share']:.1%}"
    print(f"Compared {fields['compared']} of {fields['points']} points")
    print(f"Change   significant at {fields['significant']} ({share}; 5 % by chance where nothing has changed)")
    print(f"Limit    {format_length(fields['median_detectable_m'])} is significant, in the median")
    if fields["largest_m"] is not None:
        print(f"Largest  {format_length(fields['largest_m'])}")
    print(f"Wrote    change.json, change.ply, change.png in {arguments.out}")
    print(f"Took     {time.perf_counter() - started:.1f} s")
    return ExitCode.ACCEPTED


def _refuse(arguments: Arguments, reasons: tuple[str, ...]) -> None:
    if arguments.json:
        from ..json_output import print_json

        print_json({"accepted": False, "reasons": list(reasons)})
        return
    print("Not accepted: the second scan could not be registered to the first, so nothing was compared.")
    for reason in reasons:
        print(f"  {reason}")
    print("Scans that are in one frame already are compared with --poses keep.")
