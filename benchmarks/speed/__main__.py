"""Times as ratios, each taken in turn with its peer: python -m benchmarks.speed [ROW ...] [--quick].

Every case is timed several times, now by one method and now by the other, and the quickest counts: other work on the
machine then slows both, or neither. Rows: `registration`, `refusal`, `second photograph`, `first`, `command`,
`exponents`, `pose`, `simplex`.
"""

from __future__ import annotations

import argparse

from benchmarks.speed.clock import Measure
from benchmarks.speed.pose import POSE_ROWS
from benchmarks.speed.registration import REGISTRATION_ROWS

ROWS: dict[str, Measure] = {**REGISTRATION_ROWS, **POSE_ROWS}
"""Rows by name."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rows", nargs="*", metavar="ROW", help=f"of {', '.join(ROWS)}; default: all")
    parser.add_argument("--quick", action="store_true", help="a few cases each")
    arguments = parser.parse_args()
    if unknown := set(arguments.rows) - set(ROWS):
        parser.error(f"there is no row {', '.join(sorted(unknown))}; choose of {', '.join(ROWS)}")
    for name in arguments.rows or ROWS:
        for line in ROWS[name](quick=arguments.quick):
            print(line, flush=True)


if __name__ == "__main__":
    main()
