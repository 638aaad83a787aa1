"""How good acquisition is: mounts, latencies, mosaics, runs that are killed, damaged replies, in one table with bars.

`python -m benchmarks.acquisition [ROW ...] [--quick]` measures rows, all by default, one after another; nothing else
should run meanwhile. A row named `control` shows that its measurement can fail. The thesis has one figure to set beside
these: its panoramas have some 7000 x 4000 pixels, too many for it to build a model of (2.2.3); row `large` builds one.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from functools import partial

from benchmarks.acquisition import kills as acquisition_kills
from benchmarks.acquisition import latency as acquisition_latency
from benchmarks.acquisition import mosaic as acquisition_mosaic
from benchmarks.acquisition import mount as acquisition_mount
from benchmarks.acquisition import parsers as acquisition_parsers
from benchmarks.shared.bars import Row, table

Show = Callable[[str], None]
Measure = Callable[[bool, Show], list[Row]]
"""Given whether to be quick, and what shows a line of progress."""
_QUICK_SEEDS = 2


def _mount(name: str, quick: bool, show: Show) -> list[Row]:
    return acquisition_mount.ROWS[name](seeds=_QUICK_SEEDS if quick else acquisition_mount.SEEDS, show=show)


ROWS: dict[str, Measure] = {
    **{name: partial(_mount, name) for name in acquisition_mount.ROWS},
    "mosaic": acquisition_mosaic.mosaic_rows,
    "refinement": acquisition_mosaic.refinement_rows,
    "large": acquisition_mosaic.large_rows,
    "latency": acquisition_latency.latency_rows,
    "kills": acquisition_kills.kills_rows,
    "unplugs": acquisition_kills.unplugs_rows,
    "parsers": acquisition_parsers.parsers_rows,
}


def main() -> int:
    """Print the table, progress on stderr; return 1 if a bar is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rows", nargs="*", metavar="ROW", help=f"some of {', '.join(ROWS)}; all if none is given")
    parser.add_argument("--quick", action="store_true", help="few seeds, kills and unplugs")
    options = parser.parse_args()
    if unknown := [name for name in options.rows if name not in ROWS]:
        parser.error(f"there is no row {', '.join(unknown)}; use {', '.join(ROWS)}")

    def show(line: str) -> None:
        print(line, file=sys.stderr, flush=True)

    if hasattr(os, "getloadavg"):
        show(f"load of this machine: {os.getloadavg()[0]:.2f} on {os.cpu_count()} cores")
    found = []
    for name in options.rows or ROWS:
        show(f"-- {name}")
        found += ROWS[name](options.quick, show)
    print(table(found))
    return 0 if all(row.held for row in found) else 1


if __name__ == "__main__":
    sys.exit(main())
