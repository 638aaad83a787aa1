"""Seconds per simulated case, by scene: `python benchmarks/simulate.py [CASES]`."""

from __future__ import annotations

import sys
import time

from ladarreg_core.foundations.progress import Progress
from ladarreg_core.simulate import SCENES, simulate_case


def main() -> None:
    cases = int(sys.argv[1]) if len(sys.argv) > 1 else 3
    simulate_case("boxes")  # imports and page faults
    print(f"{'scene':8} {'seconds':>8} {'CPU':>6}   by stage")
    for scene in SCENES:
        marks: dict[str, float] = {}

        def note(progress: Progress, marks: dict[str, float] = marks) -> None:
            marks[progress.label] = marks.get(progress.label, time.perf_counter())

        wall, cpu = time.perf_counter(), time.process_time()
        stages: dict[str, float] = {}
        for seed in range(100, 100 + cases):
            marks.clear()
            simulate_case(scene, seed=seed, report=note)
            ends = [*list(marks.values())[1:], time.perf_counter()]
            for (label, start), end in zip(marks.items(), ends, strict=True):
                stages[label] = stages.get(label, 0.0) + (end - start) / cases
        wall, cpu = (time.perf_counter() - wall) / cases, (time.process_time() - cpu) / cases
        print(f"{scene:8} {wall:8.2f} {cpu:6.2f}   " + ", ".join(f"{k} {v:.2f}" for k, v in stages.items()))


if __name__ == "__main__":
    main()
