"""The target `ply`: the coloured cloud, one point a return, as binary PLY."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ladarreg_core.export.clouds.cloud_part import CloudPart
from ladarreg_core.export.clouds.ply import write_layered_ply, write_ply
from ladarreg_core.export.layered_scan import LayeredScan
from ladarreg_core.export.registered_scan import RegisteredScan
from ladarreg_core.export.targets.folder import FileJob
from ladarreg_core.export.targets.target import ExportOptions
from ladarreg_core.foundations.progress import Report
from ladarreg_core.storage.replacement import OFFSET_FILE


def ply_files(handed: RegisteredScan, options: ExportOptions, report: Report | None) -> Sequence[FileJob]:
    """Return the cloud, and in the world `offset.json`."""
    del options
    comments = [
        f"photo_id {k}: {one.photo.name} ({one.registration.standing})" for k, one in enumerate(handed.photos, 1)
    ]

    def write(path: Path) -> None:
        handed.compute_colors(report)
        write_ply(path, handed.scan, handed.colors, frame=handed.frame, comments=comments, report=report)

    jobs: list[FileJob] = [("cloud.ply", write)]
    return jobs if handed.frame.name == "scanner" else [*jobs, (OFFSET_FILE, handed.frame.write)]


def layered_ply_files(parts: Sequence[LayeredScan], report: Report | None) -> Sequence[FileJob]:
    """Return `cloud.ply`, the returns of scans with their layers as properties."""
    comments = [f"photo_id {k}: {one.photo.name} ({one.registration.standing})"
                for k, one in enumerate(parts[0].handed.photos, 1)]  # fmt: skip
    clouds = [CloudPart(one.handed.scan, one.handed.colors, one.handed.frame, one.values) for one in parts]
    return [("cloud.ply", lambda path: write_layered_ply(path, clouds, comments=comments, report=report))]
