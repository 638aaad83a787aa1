"""The report on rigs: what counts as right and as wrong."""

from __future__ import annotations

import math
from dataclasses import replace

from benchmarks.matching.report import sections
from benchmarks.register import Row

RIGHT = Row("auto", "rigs", "petals, rough guess", 3, True, 1.0, 0.1, 20.0, 9.0, sigmas=1.0)
FAR = replace(RIGHT, error_px=6.1)
REFUSED = replace(RIGHT, accepted=False)
SHUFFLED = replace(RIGHT, what="petals, all photos moved on", error_px=math.inf)


def bars_of(*rows: Row) -> dict[str, tuple[float, bool]]:
    (section,) = sections(rows)
    return {bar.name: (bar.value, bar.met) for bar in section.bars}


def test_a_rig_is_right_if_it_is_accepted_and_near_and_wrong_if_it_is_accepted_and_far() -> None:
    asked, wrong = "rigs, rough guess: right, %", "rigs: accepted and wrong"
    assert bars_of(*[RIGHT] * 20) | {asked: (100.0, True), wrong: (0, True)} == bars_of(*[RIGHT] * 20)
    assert bars_of(*[RIGHT] * 18, REFUSED, REFUSED)[asked] == (90.0, False)
    assert bars_of(RIGHT, FAR)[wrong] == (1, False)
    assert bars_of(SHUFFLED)[wrong] == (1, False)
    assert bars_of(replace(SHUFFLED, accepted=False))[wrong] == (0, True)


def test_sigmas_are_held_to_both_sides() -> None:
    low, high = "rigs, rough guess: sigmas", "rigs, rough guess: sigmas, at most"
    for sigmas, met in ((0.7, (False, True)), (1.0, (True, True)), (1.3, (True, False))):
        bars = bars_of(replace(RIGHT, sigmas=sigmas))
        assert (bars[low][1], bars[high][1]) == met
