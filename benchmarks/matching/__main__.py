"""Automatic matching, set by set, every peer in the same run: python -m benchmarks.matching [--sets A,B] [--page FILE].

Simulated sets as `ladarreg simulate` makes them; `intrinsics`: the stated focal length 5 % off or k1 .15 off; `wrong`:
the scan of one room and the photograph of another; `near`: climbs forced to start from a wrong place; `blank`: pictures
of nothing; `real`: the captures beside the checkout, or where LADARREG_DATA says; `petals`, `narrow`, `64 lines`, `128
lines`: sparse lidars outdoors, from a rough guess and from none, with `sparse shuffled` and `sparse real`; `sparse
peers`: the same and two other methods from the same rough guesses; `rigs`: five pairs of them with one pose.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path

import cv2
from threadpoolctl import threadpool_limits

import ladarreg_core as lr
from benchmarks.matching.report import sections, write_page
from benchmarks.matching.sets import SETS
from benchmarks.pose.report import as_text
from benchmarks.register import Row
from ladarreg_core.simulate import simulate_case

_QUICK = 2


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", default=",".join(SETS), help=f"comma-separated, of {', '.join(SETS)}")
    parser.add_argument("--seeds", type=int, help="cases per scene and set; default: as many as the bars require")
    parser.add_argument("--quick", action="store_true", help=f"at most {_QUICK} seeds a set")
    parser.add_argument("--seed-offset", type=int, default=0)
    parser.add_argument("--add", type=Path, action="append", default=[], help="add the rows of an earlier --json")
    parser.add_argument("--json", type=Path, help="write every row here")
    parser.add_argument("--page", type=Path, help="write the tables into this page, between their markers")
    arguments = parser.parse_args()
    chosen = [name for name in arguments.sets.split(",") if name]
    if unknown := set(chosen) - set(SETS):
        parser.error(f"there is no set {', '.join(sorted(unknown))}; choose of {', '.join(SETS)}")
    cv2.setNumThreads(1)
    rows = [Row(**row) for path in arguments.add for row in json.loads(path.read_text(encoding="utf-8"))]
    with threadpool_limits(1):
        lr.register(*((made := simulate_case("boxes", seed=0)).scan, made.photo))  # imports and caches
        for name in chosen:
            ask, most = SETS[name]
            count = arguments.seeds or (min(most, _QUICK) if arguments.quick else most)
            for row in ask(range(arguments.seed_offset, arguments.seed_offset + count)):
                rows.append(row)
                print(
                    f"{row.set_name} {row.what} {row.seed}, {row.method}: {'accepted' if row.accepted else 'refused'}, "
                    f"{row.error_px:.2f} px, {row.seconds:.2f} s",
                    flush=True,
                )
            if arguments.json:  # an interrupted run keeps its results
                arguments.json.write_text(json.dumps([asdict(row) for row in rows], indent=1), encoding="utf-8")
    for section in sections(rows):
        print(f"\n{as_text(section)}", flush=True)
    if arguments.page:
        write_page(arguments.page, rows)


if __name__ == "__main__":
    main()
