"""Wall and processor times of two ways to do one thing, taken in turn."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np


class Measure(Protocol):
    """A row of the benchmark: yields its lines as they are known."""

    def __call__(self, *, quick: bool) -> Iterator[str]: ...


@dataclass(frozen=True, slots=True)
class Duration:
    """Time of one call."""

    wall: float
    """s."""
    processor: float
    """s, of all threads and of child processes that have ended."""


def duration(call: Callable[[], object]) -> Duration:
    """Return the time of one call."""
    wall, processor, before = time.perf_counter(), time.process_time(), os.times()
    call()
    wall, processor, after = time.perf_counter() - wall, time.process_time() - processor, os.times()
    # Those of children come in hundredths of a second.
    processor += sum(getattr(after, k) - getattr(before, k) for k in ("children_user", "children_system"))
    return Duration(wall, processor)


def in_turn(calls: Sequence[Callable[[], object]], *, times: int) -> list[Duration]:
    """Return the quickest time of each call; they take turns, so that other work slows all of them alike."""
    rounds = [[duration(call) for call in calls] for _ in range(times)]
    best = zip(*rounds, strict=True)
    return [Duration(min(d.wall for d in took), min(d.processor for d in took)) for took in best]


def compared(name: str, cases: Sequence[tuple[Duration, Duration]], peer: str, *, goal: str) -> str:
    """Return the line of a row: medians, and the ratio of each case to its peer.

    Args:
        name: of the row.
        cases: the times of every case, and of the peer on it.
        peer: its name.
        goal: what is asked.
    """
    wall, processor = (np.array([[getattr(d, kind) for d in case] for case in cases]) for kind in ("wall", "processor"))
    ratio, of_processor = wall[:, 0] / wall[:, 1], processor[:, 0] / np.maximum(processor[:, 1], 1e-9)
    return (
        f"{name}: {np.median(wall[:, 0]):.3f} s against {np.median(wall[:, 1]):.3f} s of {peer}; wall x "
        f"{np.median(ratio):.2f} median, {ratio.max():.2f} worst; processor x {np.median(of_processor):.2f}; "
        f"{len(cases)} cases (asked: {goal})"
    )
