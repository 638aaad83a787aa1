"""The embedded sample as a project."""

from __future__ import annotations

from pathlib import Path

from ladarreg_core.project.history import NOBODY

from .workbench import Workbench

SAMPLE_NAME = "Sample"


def sample_files() -> tuple[Path, Path, Path]:
    """Return the sample's scan, photograph and camera file."""
    from ladarreg_core.simulate import sample_folder

    folder = sample_folder()
    return folder / "scan.npz", next(folder.glob("photo.*")), folder / "camera.json"


def register_sample(workbench: Workbench, *, fresh: bool = False) -> None:
    """Register the sample unless the project already contains work on it.

    Args:
        workbench: the workbench on the sample.
        fresh: whether to start over.
    """
    shown = workbench.selection.photo
    assert shown is not None, "the sample has a photograph"
    if fresh:
        workbench.start_over(shown.id)
    if fresh or (not shown.picks and not shown.poses):
        workbench.jobs.run("auto", shown.id, NOBODY)
