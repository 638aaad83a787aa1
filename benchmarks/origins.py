"""Where the scanner of a cloud stood, found from the points: right, asked for, or wrong.

`python -m benchmarks.origins [--cases N] [--first SEED]`
"""

from __future__ import annotations

import argparse
import time
from collections import Counter

from ladarreg_core.scanner.origin import estimate_origin
from testing.scenes.origin_cases import KINDS, draw_origin_case


def main(cases: int, first: int) -> None:
    """Print every wrong case, and a row for each kind of cloud."""
    counts: dict[str, Counter[str]] = {kind: Counter() for kind in KINDS}
    largest_m = dict.fromkeys(KINDS, 0.0)  # error of a place that counts as right
    started = time.perf_counter()
    for seed in range(first, first + cases):
        case = draw_origin_case(seed)
        found = estimate_origin(case.points)
        verdict = case.verdict(found)
        counts[case.kind][verdict] += 1
        if verdict == "right":
            largest_m[case.kind] = max(largest_m[case.kind], case.error_m(found))
        if verdict == "wrong":
            print(f"wrong: {case.name}: {found.position}", flush=True)
    for kind, count in counts.items():
        print(
            f"{kind:16} right {count['right']:4} (at most {largest_m[kind]:.3f} m off)  asked {count['asked']:4}  "
            f"wrong {count['wrong']:4}"
        )
    print(f"{(time.perf_counter() - started) / max(cases, 1):.1f} s a cloud")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    arguments = parser.parse_args()
    main(arguments.cases, arguments.first)
