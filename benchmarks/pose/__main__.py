"""Pose estimation against its bounds and its peers: python -m benchmarks.pose [--seeds N] [--json FILE] [--page FILE].

Accuracy among mismatches, times, basins, placement, drawn lines, intrinsics, Table 3.1 of the thesis and verdicts;
every figure that the code is held to stands beside its bar. The bars are for 200 seeds.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import cv2
from threadpoolctl import threadpool_limits

from benchmarks.pose.accuracy import mismatches_section, placement_section, times_section
from benchmarks.pose.intrinsics import intrinsics_section
from benchmarks.pose.lines import lines_section
from benchmarks.pose.report import Section, as_text, write_json, write_page
from benchmarks.pose.starts import basins_section, verdicts_section
from benchmarks.thesis.estimation import THESIS_SECTIONS
from benchmarks.thesis.table_3_1 import table_3_1_section

SECTIONS: dict[str, Callable[[Sequence[int]], Section]] = {
    "mismatches": mismatches_section,
    "times": times_section,
    "basins": basins_section,
    "placement": placement_section,
    "lines": lines_section,
    "intrinsics": intrinsics_section,
    "table-3-1": table_3_1_section,
    "verdicts": verdicts_section,
}


def run(
    sections: Sequence[Callable[[Sequence[int]], Section]], seeds: Sequence[int]
) -> Iterator[tuple[Section, float]]:
    """Run the sections one after another, each timed."""
    for ask in sections:
        begin = time.perf_counter()
        yield ask(seeds), time.perf_counter() - begin


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=60)
    parser.add_argument("--first-seed", type=int, default=0, help="first seed")
    parser.add_argument("--only", help=f"some of the sections, comma-separated: {', '.join(SECTIONS)}")
    parser.add_argument("--thesis", action="store_true", help="only the thesis's nonlinear estimation")
    parser.add_argument("--json", type=Path, help="write every figure here")
    parser.add_argument("--page", type=Path, help="write the tables into this page, between their markers")
    arguments = parser.parse_args()
    if arguments.seeds < 2:
        parser.error("--seeds must be at least 2")
    chosen = arguments.only.split(",") if arguments.only else list(SECTIONS)
    if unknown := set(chosen) - set(SECTIONS):
        parser.error(f"there is no section {', '.join(sorted(unknown))}; choose of {', '.join(SECTIONS)}")
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
    cv2.setNumThreads(1)
    answered: list[Section] = []
    with threadpool_limits(1):
        for section, seconds in run(
            THESIS_SECTIONS if arguments.thesis else [SECTIONS[name] for name in chosen], seeds
        ):
            print(f"{as_text(section)}  ({seconds:.0f} s)\n", flush=True)
            answered.append(section)
            # An interrupted run keeps its results.
            if arguments.json:
                write_json(arguments.json, answered, seeds=seeds)
            if arguments.page:
                write_page(arguments.page, answered, seeds=seeds)
    bars = [bar for section in answered for bar in section.bars]
    if bars:
        missed = [bar for bar in bars if not bar.met]
        print(f"{len(bars) - len(missed)} of {len(bars)} figures are met at {len(seeds)} seeds")
        for bar in missed:
            name, value, held, verdict = bar.cells()
            print(f"  {verdict}  {name}: {value} (held to {held})")


if __name__ == "__main__":
    main()
