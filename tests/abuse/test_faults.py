"""A drawn share of `benchmarks.abuse.faults`: calls that fail, memory that ends, power that is lost."""

from __future__ import annotations

import random

import pytest

from testing.attacks import fault_rounds
from testing.attacks.fault_cases import CASES
from testing.attacks.system_calls import KINDS, can_watch

pytestmark = pytest.mark.skipif(not can_watch(), reason="this system does not hand over system calls")
_CALLS, _STATES = 3, 6
_LIMITS_KB = (64, 2048)


@pytest.fixture(scope="module", autouse=True)
def _loaded_once() -> None:
    fault_rounds.ready()


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_any_call_may_fail(case: str) -> None:
    counted = fault_rounds.counted(case)
    assert (counted.said, counted.wrong) == ("", [])
    every = [(kind, number) for kind in KINDS for number in range(counted.calls[kind])]
    for kind, number in random.Random(case).sample(every, _CALLS):
        assert fault_rounds.faulted(case, kind, number).wrong == [], (kind, number)


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_power_may_be_lost_at_any_time(case: str) -> None:
    for found in fault_rounds.powerless(case, most=_STATES):
        assert found.wrong == [], found.what


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_memory_may_end(case: str) -> None:
    for limit_kb in _LIMITS_KB:
        assert fault_rounds.limited(case, limit_kb << 10).wrong == [], limit_kb
