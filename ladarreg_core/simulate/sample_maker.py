"""Makes the embedded sample anew: `python -m ladarreg_core.simulate.sample_maker [FOLDER]`."""

from __future__ import annotations

import logging
import sys
from pathlib import Path

from ladarreg_core.simulate.case import simulate_case
from ladarreg_core.simulate.case_files import write_case

SCENE = "office"
SEED = 6
"""A room with something at every depth, seen well by both."""

_log = logging.getLogger(__name__)


def make_sample(folder: Path) -> None:
    """Write the sample's files into a folder."""
    write_case(simulate_case(SCENE, seed=SEED), folder)


def main() -> None:
    """Write the sample into the package, or into the folder named on the command line."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).resolve().parent / "sample_files"
    make_sample(folder)
    for path in sorted(folder.iterdir()):
        _log.info("%s: %.0f kB", path, path.stat().st_size / 1000)


if __name__ == "__main__":
    main()
