"""Slices as they are sent to clients: only the changes, encoded once for all, ending in the server's own state."""

from __future__ import annotations

import json
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from ladarreg.gateway import encoding
from ladarreg.gateway.delta import apply_change, change_between
from ladarreg.gateway.document_socket import ClientState, Outbox
from ladarreg.gateway.encoding import SharedEncoder
from ladarreg.session.cache import ListCache

from testing.workbench.slice_edits import random_states


class Reader:
    """A client in Python."""

    def __init__(self, shared: SharedEncoder) -> None:
        self.state = ClientState(shared)
        self.slices: dict[str, Any] = {}
        self.version = 0

    def read(self, slices: dict[str, Any]) -> str:
        """Receive changed slices; return the text that was sent."""
        text = self.state.encode({"slices": slices})
        message = json.loads(text)
        self.version += 1
        assert message["version"] == self.version
        self.slices |= message["slices"]
        for name, change in message.get("changes", {}).items():
            self.slices[name] = apply_change(self.slices[name], change)
        self.slices = {name: value for name, value in self.slices.items() if value is not None}
        return text


def present(state: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in state.items() if value is not None}


def news(before: dict[str, Any], after: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in after.items() if before.get(name) is not value}


def many(count: int, **others: Any) -> list[dict[str, Any]]:
    return [{"id": str(k), "photo": [[k, 1.5]], "on": True, **others} for k in range(count)]


@pytest.mark.slow
@given(st.integers(0, 2**32), st.lists(st.booleans(), min_size=40, max_size=40))
def test_every_client_ends_with_the_servers_state(seed: int, looks: list[bool]) -> None:
    """One client receives everything, another only now and then through an outbox; a third connects in the middle."""
    shared, outbox = SharedEncoder(), Outbox(lambda: None)
    quick, slow, late = Reader(shared), Reader(shared), Reader(shared)
    states = random_states(seed, len(looks))
    quick.read(states[0])
    slow.read(states[0])
    for k, (before, after) in enumerate(pairwise(states)):
        quick.read(news(before, after))
        assert quick.slices == present(after)
        outbox.put({"slices": news(before, after)})
        if looks[k]:
            for message in outbox.take()[0]:
                slow.read(message["slices"])
            assert slow.slices == present(after)
        if k == len(looks) // 2:
            late.read(after)
        elif late.version:
            late.read(news(before, after))
    assert late.slices == quick.slices


@given(st.integers(0, 2**32))
def test_a_change_turns_one_value_into_the_other_and_modifies_neither(seed: int) -> None:
    for before, after in pairwise(random_states(seed, 30)):
        for name in after:
            was, kept = before.get(name), json.dumps(before.get(name))
            change = change_between(was, after[name])
            if change is not None:
                assert apply_change(was, json.loads(json.dumps(change))) == after[name]
                assert list(apply_change(was, change)) == list(after[name]) or isinstance(was, dict)
            assert json.dumps(was) == kept


def test_a_change_of_one_pick_contains_only_that_pick() -> None:
    picks = many(500)
    moved = [*picks[:7], {**picks[7], "photo": [[9, 9]]}, *picks[8:]]
    assert change_between(picks, moved) == {"set": [moved[7]]}
    assert change_between(picks, picks[1:]) == {"gone": ["0"]}
    new = {"id": "new", "photo": [[0, 0]], "on": False}
    assert change_between(picks, [*picks, new]) == {"set": [new]}
    assert change_between([*picks[:3], *picks[4:]], picks) == {"set": [picks[3]], "order": [p["id"] for p in picks]}
    judged = {"stage": "robust", "by_pick": {str(k): {"px": k} for k in range(500)}, "losses": ["a"]}
    by_pick = {name: said for name, said in judged["by_pick"].items() if name != "3"} | {"4": {"px": 0.5}}
    assert change_between(judged, {**judged, "by_pick": by_pick}) == {
        "in": {"by_pick": {"set": {"4": {"px": 0.5}}, "gone": ["3"]}}
    }
    entries = [{"n": k, "label": "Move"} for k in range(300)]
    later = {"at": 300, "entries": [*entries[1:], {"n": 300, "label": "Move"}]}
    assert change_between({"at": 299, "entries": entries}, later) == {
        "set": {"at": 300},
        "in": {"entries": {"set": [{"n": 300, "label": "Move"}], "gone": [0]}},
    }


@pytest.mark.parametrize(
    ("before", "after"),
    [
        (None, many(500)),
        (many(500), many(500, weight=2)),
        (many(500), many(5)),
        (many(500), [[0.5, 0.5]] * 500),
        (many(500), many(400) + many(1)),
        ({"by_pick": {}}, {"by_pick": {str(k): k for k in range(100)}}),
        ("a", "b"),
        ({"count": 1}, {"count": 2}),
    ],
)
def test_a_mostly_new_value_is_sent_whole(before: Any, after: Any) -> None:
    assert change_between(before, after) is None


def test_a_change_of_another_value_is_refused() -> None:
    with pytest.raises(KeyError):
        apply_change(many(3), {"order": ["9"]})
    with pytest.raises(KeyError):
        apply_change({}, {"in": {"by_pick": {}}})


def test_all_clients_share_one_encoding(monkeypatch: pytest.MonkeyPatch) -> None:
    made = []
    plain = encoding.encode_part
    monkeypatch.setattr(encoding, "encode_part", lambda value: made.append(value) or plain(value))
    shared = SharedEncoder()
    readers = [Reader(shared) for _ in range(3)]
    picks = many(200)
    assert len({reader.read({"picks:p1": picks}) for reader in readers}) == 1
    moved = [{**picks[0], "on": False}, *picks[1:]]
    assert len({reader.read({"picks:p1": moved}) for reader in readers}) == 1
    assert made == [picks, {"set": moved[:1]}]


def test_unchanged_items_are_made_once() -> None:
    made: list[str] = []
    each: ListCache[str, str] = ListCache(lambda thing: made.append(thing) or thing.upper())
    things = ["one", "two"]
    assert each.get("a", things) is each.get("a", things)
    assert each.get("a", ["zero", *things]) == ["ZERO", "ONE", "TWO"]
    assert each.get("b", things) == ["ONE", "TWO"]
    assert made == ["one", "two", "zero", "one", "two"]


@given(st.lists(st.lists(st.integers(0, 6), unique=True), max_size=6))
def test_only_new_items_of_a_list_are_made(lists: list[list[int]]) -> None:
    things = [object() for _ in range(7)]
    made: list[object] = []
    each: ListCache[object, tuple[object]] = ListCache(lambda thing: made.append(thing) or (thing,))
    before: list[object] = []
    for chosen in lists:
        now = [things[k] for k in chosen]
        made.clear()
        assert each.get("a", now) == [(thing,) for thing in now]
        assert not [thing for thing in made if thing in before]
        before = now
