"""The statement of a registration by survey targets, as files: `targets.json`, and a table of residuals.

That of several scans is part of their `stations.json`, beside the scans with their poses.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ladarreg_core.export.json import software_document, write_result
from ladarreg_core.export.outputs.station_folder import StationScan, write_stations
from ladarreg_core.export.targets.folder import FileJob, write_folder
from ladarreg_core.foundations.progress import Report
from ladarreg_core.registration.stations.results import PlacedStation, StationNetwork
from ladarreg_core.registration.stations.survey_target import SurveyTarget
from ladarreg_core.registration.stations.target_pose import TargetNetwork, TargetRegistration
from ladarreg_core.storage.atomic_write import write_bytes

TARGETS_FILE, TABLE_FILE = "targets.json", "targets.csv"
"""The statement, and its residuals as a table."""
_CENTER_IS = "in the scanner's frame, m"


def write_target_statement(
    folder: str | Path,
    found: TargetRegistration,
    targets: Mapping[str, SurveyTarget],
    *,
    details: Mapping[str, Any] | None = None,
    inputs: Sequence[str | Path] = (),
    force: bool = False,
) -> dict[str, Any]:
    """Write where a scanner stood by its targets into a new folder, and return the document.

    Args:
        folder: output folder.
        found: the registration.
        targets: the targets in the scan, by name.
        details: what else is stated, such as the standard deviation of the coordinates.
        inputs: files that must not be replaced.
        force: replace an earlier statement.

    Raises:
        ExportError: if the folder exists and must not be replaced, or cannot be written.
    """
    fields = found.as_fields()
    for one in fields["targets"]:
        one |= _sighting(targets[one["name"]])
    document = {
        "version": 1,
        "kind": "targets",
        "software": software_document(),
        **fields,
        **(details or {}),
        "covariance_is": "of (w, c): R_true = exp([w]x) R (rad), c = true minus estimated scanner centre (m), in the "
        "frame of the coordinates",
        "residual_is": "surveyed minus measured, m, in the frame of the coordinates",
        "center_is": _CENTER_IS,
    }
    jobs: list[FileJob] = [
        (TARGETS_FILE, lambda path: write_result(path, document)),
        (TABLE_FILE, lambda path: write_bytes(path, _table(fields["targets"]))),
    ]
    write_folder(folder, lambda: jobs, inputs=inputs, more_names=[name for name, _ in jobs], force=force)
    return document


def write_network_statement(
    folder: str | Path,
    found: TargetNetwork,
    targets: Mapping[str, Mapping[str, SurveyTarget]],
    stations: Sequence[StationScan],
    *,
    details: Mapping[str, Any] | None = None,
    force: bool = False,
    report: Report | None = None,
) -> dict[str, Any]:
    """Write where several scanners stood by their targets into a new folder of stations, and return `stations.json`.

    Args:
        folder: output folder.
        found: the registration.
        targets: the targets in each scan, by name.
        stations: the scans, in the order of the registration.
        details: what else is stated.
        force: replace an earlier folder of stations.
        report: receives the progress.

    Raises:
        ExportError: if the folder exists and must not be replaced, or cannot be written.
    """
    statement = found.as_fields()
    rows = []
    for scan in statement["scans"]:
        for one in scan["targets"]:
            one |= _sighting(targets[scan["scan"]][one["name"]])
        rows += [(scan["scan"], one) for one in scan["targets"]]
    rows += [("", one) for one in statement["coordinates"]]
    statement |= {
        "residual_is": "the target's place, by all that see it, minus where this scan puts it, in the world, m; of "
        "coordinates: surveyed minus that place",
        "center_is": _CENTER_IS, **(details or {}),
    }  # fmt: skip
    world = "that of the surveyed coordinates" if found.in_coordinates else "the frame of the first scanner"
    names = list(found.world_from_scanner)
    network = StationNetwork(
        tuple(
            PlacedStation(
                k, name, "fixed" if k == 0 and not found.in_coordinates else "registered",
                found.world_from_scanner[name], found.covariance_of(name),
            )
            for k, name in enumerate(names)
        ),
        (), (), found.reasons,
        statement={
            "poses_are": "world_from_scanner maps points of each scanner (X forward, Y left, Z up, m) to the world, "
            f"{world}; covariance is of (w, c): R_true = exp([w]x) R, c = C_true - C, rad and m, in the world",
            "targets": statement,
        },
    )  # fmt: skip
    table = _scans_table(rows)
    return write_stations(folder, network, stations, tables={TABLE_FILE: table}, force=force, report=report)


def _sighting(target: SurveyTarget) -> dict[str, Any]:
    return {
        "kind": "sphere" if target.side_m is None else "flat",
        "center_m": target.center.tolist(), "center_sigma_m": np.sqrt(np.diag(target.covariance)).tolist(),
    }  # fmt: skip


def _table(targets: Sequence[Mapping[str, Any]]) -> bytes:
    return _csv(_COLUMNS, [_cells(one) for one in targets])


def _scans_table(rows: Sequence[tuple[str, Mapping[str, Any]]]) -> bytes:
    """Return the residuals of several scans as a table; coordinates are of no scan."""
    return _csv(["scan", *_COLUMNS], [[scan, *_cells(one)] for scan, one in rows])


_COLUMNS = ("name", "used", "dx_mm", "dy_mm", "dz_mm", "length_mm")


def _cells(one: Mapping[str, Any]) -> list[Any]:
    off = 1000 * np.asarray(one["residual_m"])
    return [one["name"], int(one["used"]), *(f"{value:.3f}" for value in (*off, np.linalg.norm(off)))]


def _csv(header: Sequence[str], lines: Sequence[Sequence[Any]]) -> bytes:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([header, *lines])
    return text.getvalue().encode()
