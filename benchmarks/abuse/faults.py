"""Saves, exports and runs of which any call may fail, the power may be lost at any moment, or memory may end."""

from __future__ import annotations

from benchmarks.abuse.log import Log
from testing.attacks import fault_rounds
from testing.attacks.fault_cases import CASES
from testing.attacks.fault_rounds import Round
from testing.attacks.system_calls import KINDS, can_watch

SECTION = "faults"
_MAX_STATES = 100
"""States after a loss of power that are tried in each case, where only a share is tried."""
_MIN_MEMORY_BYTES, _GROWTH = 4096, 1.25
"""The first limit, beyond what is in use, and the ratio of each to the one before: fifty reach 230 MB."""


def run(log: Log, limits: int, every: int) -> None:
    """Fail every n-th call of each case (1: all), lose power in as large a share, and try this many memory limits."""
    if not can_watch():
        return
    fault_rounds.ready()
    for case in CASES:
        if not log.of(SECTION, case=case, kind="power"):
            most = None if every == 1 else _MAX_STATES // every
            _note(log, case, "power", "", [*fault_rounds.powerless(case, most=most)])
    for case in CASES:
        if not log.of(SECTION, case=case, kind="memory"):
            sizes = [int(_MIN_MEMORY_BYTES * _GROWTH**k) for k in range(limits)]
            _note(log, case, "memory", "", [fault_rounds.limited(case, size) for size in sizes])
    for call in KINDS:
        for case in CASES:
            if not log.of(SECTION, case=case, kind="calls", call=call):
                numbers = range(len(case) % every, fault_rounds.counted(case).calls[call], every)
                _note(log, case, "calls", call, [fault_rounds.faulted(case, call, number) for number in numbers])


def _note(log: Log, case: str, kind: str, call: str, found: list[Round]) -> None:
    wrong = [f"{one.what}: {'; '.join(one.wrong)}" for one in found if one.wrong]
    ended, crashed = sum(bool(one.said) for one in found), sum(one.crashed for one in found)
    log.add(
        SECTION, case=case, kind=kind, call=call, rounds=len(found), ended=ended, crashed=crashed, wrong=len(wrong),
        first=wrong[:20],
    )  # fmt: skip
