from __future__ import annotations

import threading
import time

import pytest

from ladarreg_core.side_by_side import side_by_side


@pytest.mark.parametrize("count", [0, 1, 2, 3, 20])
def test_results_keep_the_order_of_the_items(count: int) -> None:
    assert side_by_side(lambda k: k * k, range(count)) == [k * k for k in range(count)]


def test_every_item_is_worked_on_once() -> None:
    seen: list[int] = []
    side_by_side(seen.append, range(200))
    assert sorted(seen) == list(range(200))


@pytest.mark.parametrize("wrong", [{3}, {3, 7}, {0}, {9}, set(range(10))])
def test_the_first_error_in_the_order_of_the_items_is_raised(wrong: set[int]) -> None:
    def work(k: int) -> int:
        if k in wrong:
            raise ValueError(k)
        return k

    with pytest.raises(ValueError, match=f"^{min(wrong)}$"):
        side_by_side(work, range(10))


def test_no_thread_is_left_behind() -> None:
    before = threading.active_count()
    side_by_side(lambda k: k, range(5))
    assert threading.active_count() == before


def test_it_tells_before_every_item_in_order_and_begins_none_after_a_refusal() -> None:
    told: list[int] = []
    side_by_side(lambda k: k, range(30), before=told.append)
    assert told == list(range(30))

    begun: list[int] = []

    def work(k: int) -> None:
        begun.append(k)
        time.sleep(0.2)  # all thirty take six seconds

    def refuse(_: int) -> None:
        raise KeyError("stop")

    with pytest.raises(KeyError):
        side_by_side(work, range(30), before=refuse)
    assert len(begun) < 30
