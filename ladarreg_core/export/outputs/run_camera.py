"""The camera of a run: where it is mounted on the unit, and the pose of each of its photographs in the panorama."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ladarreg_core.acquisition.composition.panorama import Panorama
from ladarreg_core.acquisition.runs.piece_list import PLAN_FILE
from ladarreg_core.acquisition.runs.run_folder import RunSummary, summary
from ladarreg_core.errors import OptionError
from ladarreg_core.formats import read_photo
from ladarreg_core.formats.parsing.untrusted import shown_name
from ladarreg_core.foundations.progress import Report
from ladarreg_core.frames import Rigid
from ladarreg_core.registration.register import RegisterOptions
from ladarreg_core.registration.rig.unit_camera import UnitCamera, register_unit_camera
from ladarreg_core.scanner.pan_tilt import pan_tilt_pose


def calibrate_run_camera(
    run_folder: str | Path,
    panorama: Panorama,
    *,
    base: Rigid | None = None,
    photo_options: Mapping[str, Any] | None = None,
    options: RegisterOptions | None = None,
    report: Report | None = None,
) -> UnitCamera:
    """Estimate where the camera of a run is mounted, from the photographs that it took at the stops.

    Args:
        run_folder: folder of the run.
        panorama: what was composed of it.
        base: `level_from_unit` that it was composed with; None: that of the plan.
        photo_options: arguments of `read_photo`.
        options: of the registrations.
        report: receives the progress; may raise `Cancelled`.

    Raises:
        OptionError: if the run has no photographs.
        LadarregError: if a photograph cannot be read, or its focal length is not known.
    """
    run = _run(run_folder)
    positions = {} if run is None else _positions(run, base)
    if run is None or not positions:
        raise OptionError(
            f"{shown_name(run_folder)} has no photographs; the mount of a camera is estimated from those of a run "
            "whose plan has a camera"
        )
    photos = [read_photo(path, **dict(photo_options or {})) for path in positions]
    return register_unit_camera(
        panorama.scan, photos, list(positions.values()), names=[path.name for path in positions],
        initial=_stated_mount(run), is_scanner_mount_known=panorama.fields["mount"]["from"] == "estimated",
        options=options, report=report,
    )  # fmt: skip


def photo_poses(
    run_folder: str | Path, unit_from_camera: Rigid | None, *, base: Rigid | None = None
) -> dict[str, Rigid]:
    """Return `camera_from_scanner` in the panorama of each photograph of a run, by its file's name without suffix.

    Args:
        run_folder: folder of a run; of anything else there are none.
        unit_from_camera: the mount; None: that of the plan, without which there are none.
        base: `level_from_unit` that the panorama was composed with; None: that of the plan.
    """
    run = _run(run_folder)
    mount = None if run is None else unit_from_camera or _stated_mount(run)
    if run is None or mount is None:
        return {}
    return {path.stem: (unit @ mount).inverse for path, unit in _positions(run, base).items()}


def _run(run_folder: str | Path) -> RunSummary | None:
    """Return what a run has; None of anything else, such as a list of pieces."""
    return summary(run_folder) if (Path(run_folder) / PLAN_FILE).is_file() else None


def _positions(run: RunSummary, base: Rigid | None) -> dict[Path, Rigid]:
    """Return `world_from_unit` of the part of the unit that pans and tilts, for each photograph."""
    level = run.plan.base if base is None else base
    return {path: level @ pan_tilt_pose(math.radians(pan), math.radians(tilt)) for path, (pan, tilt) in run.photos}


def _stated_mount(run: RunSummary) -> Rigid | None:
    return None if run.plan.camera is None else run.plan.camera.mount
