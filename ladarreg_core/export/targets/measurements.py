"""The target `measurements`: what was measured in a project, for tables, CAD, GIS and programs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from ladarreg_core.export.targets.folder import FileJob
from ladarreg_core.export.targets.target import ExportOptions
from ladarreg_core.foundations.progress import Report

SUFFIXES = (".csv", ".json", ".geojson", ".dxf")
"""How the names of its files end: all forms of a list of measurements."""


@dataclass(frozen=True, slots=True, eq=False)
class MeasurementList:
    """Measurements that can be written."""

    write: Callable[[Path], None]
    """Writes them into a new file; its suffix says how, see `measuring.measurement_list.write_measurements`."""
    inputs: Sequence[Path] = ()
    """The files that were measured."""


def measurements_files(source: MeasurementList, options: ExportOptions, report: Report | None) -> Sequence[FileJob]:
    """Return the same list in each of its forms."""
    del options, report
    return [(f"measurements{suffix}", source.write) for suffix in SUFFIXES]
