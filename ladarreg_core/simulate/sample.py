"""The sample that is shipped with the package: what `demo` shows, readable without a ray caster.

`python -m ladarreg_core.simulate.sample [FOLDER]` makes it again, in the package or in another folder.
"""

from __future__ import annotations

import logging
import sys
from pathlib import Path

from ladarreg_core.errors import FormatError
from ladarreg_core.simulate.case import simulate_case, write_case

SAMPLE_FILES = ("scan.npz", "photo.png", "camera.json", "truth.json")
SCENE = "office"
SEED = 6
"""A room with objects at every depth that both scanner and camera see well."""

_log = logging.getLogger(__name__)


def sample_folder() -> Path:
    """Return the folder with `scan.npz`, `photo.png`, `camera.json` and `truth.json` of the embedded sample.

    Raises:
        FormatError: if the installed package is incomplete.
    """
    folder = _package_folder()
    missing = [name for name in SAMPLE_FILES if not (folder / name).is_file()]
    if missing:
        raise FormatError(
            f"the embedded sample lacks {', '.join(missing)}; install ladarreg again, or in a checkout run "
            "python -m ladarreg_core.simulate.sample"
        )
    return folder


def sample_survey_folder() -> Path:
    """Return the folder of the embedded sample survey: two scans, ten photographs of two cameras, `truth.json`.

    Eight photographs are of the room, one is a close-up, and one is of another room.

    Raises:
        FormatError: if the installed package is incomplete.
    """
    folder = Path(__file__).resolve().parent / "sample_survey"
    if not folder.is_dir():
        raise FormatError("the embedded sample survey is missing; install ladarreg again")
    return folder


def make_sample(folder: Path) -> None:
    """Write the sample's files into a folder."""
    write_case(simulate_case(SCENE, seed=SEED), folder)


def main() -> None:
    """Write the sample into the package, or into the folder named on the command line."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else _package_folder()
    make_sample(folder)
    for path in sorted(folder.iterdir()):
        _log.info("%s: %.0f kB", path, path.stat().st_size / 1000)


def _package_folder() -> Path:
    return Path(__file__).resolve().parent / "sample_files"


if __name__ == "__main__":
    main()
