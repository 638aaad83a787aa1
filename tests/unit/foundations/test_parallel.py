from __future__ import annotations

import os
import threading
import weakref
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import cv2
import pytest

from ladarreg_core.foundations.parallel import OtherCore, made_once, one_thread, side_by_side


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


@pytest.fixture
def leaving(monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """An event that comes once a pool was told to end, has dropped what was waiting, and waits for its threads."""
    event = threading.Event()

    class Pool(ThreadPoolExecutor):
        def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
            super().shutdown(wait=False, cancel_futures=cancel_futures)
            event.set()
            super().shutdown(wait=wait)

    monkeypatch.setattr("ladarreg_core.foundations.parallel.ThreadPoolExecutor", Pool)
    return event


def test_it_tells_before_every_item_in_order_and_begins_none_after_a_refusal(leaving: threading.Event) -> None:
    told: list[int] = []
    side_by_side(lambda k: k, range(30), before=told.append)
    assert told == list(range(30))

    begun: list[int] = []

    def work(k: int) -> None:
        begun.append(k)
        assert leaving.wait(60)

    def refuse(_: int) -> None:
        raise KeyError("stop")

    with pytest.raises(KeyError):
        side_by_side(work, range(30), before=refuse)
    assert len(begun) <= 1, "that of the other thread"


def test_work_begun_gives_its_result_whether_it_was_begun_or_not() -> None:
    with OtherCore() as other_core:
        begun = [other_core.begin(partial(pow, k, 2)) for k in range(50)]
        assert [piece.result() for piece in reversed(begun)] == [k * k for k in reversed(range(50))]


def test_with_one_core_work_is_done_when_its_result_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 1)
    done: list[int] = []
    with OtherCore() as other_core:
        first, _ = (other_core.begin(partial(done.append, k)) for k in range(2))
        assert not done
        first.result()
    assert done == [0]


def test_an_error_of_begun_work_is_raised_where_its_result_is_asked_for() -> None:
    with OtherCore() as other_core:
        wrong = other_core.begin(partial(divmod, 1, 0))
        other_core.begin(partial(divmod, 1, 0))
        with pytest.raises(ZeroDivisionError):
            wrong.result()


def test_at_the_end_what_is_at_work_is_waited_for_and_the_rest_is_dropped(leaving: threading.Event) -> None:
    before, started, ended = threading.active_count(), threading.Event(), threading.Event()
    later: list[int] = []

    def work() -> None:
        started.set()
        assert leaving.wait(60)
        ended.set()

    def stop() -> None:
        with OtherCore() as other_core:
            other_core.begin(work)
            other_core.begin(partial(later.append, 1))
            assert started.wait(60)
            raise KeyError("stop")

    with pytest.raises(KeyError):
        stop()
    assert ended.is_set()
    assert not later
    assert threading.active_count() == before


class Slow:
    """Counts how often its value is made, which takes until it is told that everybody asks."""

    made = 0

    def __init__(self) -> None:
        self.asked = threading.Event()

    @made_once
    def value(self) -> int:
        """The value."""
        self.made += 1
        assert self.asked.wait(60)
        return self.made


def another() -> Slow:
    slow = Slow()
    slow.asked.set()
    return slow


def test_what_two_threads_ask_for_is_made_once() -> None:
    slow, found = Slow(), list[int]()

    def ask() -> None:
        begun.release()
        found.append(slow.value)

    begun = threading.Semaphore(0)
    threads = [threading.Thread(target=ask) for _ in range(4)]
    for thread in threads:
        thread.start()
    for _ in threads:
        begun.acquire()
    slow.asked.set()
    for thread in threads:
        thread.join()
    assert found == [1] * 4
    assert slow.made == 1
    assert another().value == 1


def test_what_is_made_once_lives_no_longer_than_its_owner() -> None:
    slow = another()
    assert slow.value == 1
    alive = weakref.ref(slow)
    del slow
    assert alive() is None


@pytest.fixture
def two_of_opencv() -> Iterator[None]:
    before = cv2.getNumThreads()
    cv2.setNumThreads(2)
    yield
    cv2.setNumThreads(before)


@pytest.mark.usefixtures("two_of_opencv")
def test_in_one_thread_no_other_is_begun_and_earlier_settings_return() -> None:
    def here(_: int) -> threading.Thread:
        return threading.current_thread()

    def fail() -> None:
        with one_thread(), one_thread():
            raise KeyError("stop")

    with one_thread():
        assert set(side_by_side(here, range(20))) == {threading.current_thread()}
        with OtherCore() as other_core:
            begun = [other_core.begin(partial(here, k)) for k in range(3)]
            assert {piece.result() for piece in begun} == {threading.current_thread()}
        assert cv2.getNumThreads() == 1
        with pytest.raises(KeyError):
            fail()
        assert cv2.getNumThreads() == 1
        assert set(side_by_side(here, range(2))) == {threading.current_thread()}
    assert cv2.getNumThreads() == 2


@pytest.mark.usefixtures("two_of_opencv")
def test_the_last_that_asks_for_one_thread_gives_opencv_its_threads_back() -> None:
    inside, leave = threading.Event(), threading.Event()

    def stay() -> None:
        with one_thread():
            inside.set()
            assert leave.wait(60)

    other = threading.Thread(target=stay)
    with one_thread():
        other.start()
        assert inside.wait(60)
    assert cv2.getNumThreads() == 1, "the other one is not done"
    leave.set()
    other.join()
    assert cv2.getNumThreads() == 2
