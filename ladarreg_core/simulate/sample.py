"""The sample that comes with the package: what `demo` shows and what needs no ray caster."""

from __future__ import annotations

from pathlib import Path

from ladarreg_core.errors import FormatError

SAMPLE_FILES = ("scan.npz", "photo.png", "camera.json", "truth.json")


def sample_folder() -> Path:
    """Return the folder with `scan.npz`, `photo.png`, `camera.json` and `truth.json` of the embedded sample.

    Raises:
        FormatError: if the installed package is not whole.
    """
    folder = Path(__file__).resolve().parent / "sample_files"
    missing = [name for name in SAMPLE_FILES if not (folder / name).is_file()]
    if missing:
        raise FormatError(
            f"the embedded sample lacks {', '.join(missing)}; install ladarreg again, or in a checkout run "
            "python -m ladarreg_core.simulate.sample_maker"
        )
    return folder
