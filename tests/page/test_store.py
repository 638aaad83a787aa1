"""The page's copy of the document: it follows the server, and reports when it cannot."""

from __future__ import annotations

import json
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import pytest
from ladarreg.gateway.document_socket import ClientState
from ladarreg.gateway.encoding import SharedEncoder

from testing.workbench.slice_edits import random_states

if TYPE_CHECKING:
    from playwright.sync_api import Page

FOLLOWING = """async ([texts, names]) => {
  const { Store } = await import('/js/net/store.js');
  const store = new Store();
  const seen = [];
  const heard = [];
  store.on('*', (value, name) => heard.push(name));
  for (const text of texts) {
    const taken = store.take(JSON.parse(text));
    seen.push([taken, Object.fromEntries(names.map((name) => [name, store.get(name)])), heard.splice(0)]);
  }
  return seen;
}"""


@pytest.fixture
def blank(page: Page, modules: str) -> Page:
    """An empty page of the same origin."""
    page.goto(f"{modules}/blank.html")
    return page


def texts_of(states: list[dict[str, Any]]) -> list[str]:
    """Return the messages to a page that is connected from the first state on."""
    state = ClientState(SharedEncoder())
    found = [state.encode({"slices": states[0]})]
    for before, after in pairwise(states):
        found.append(state.encode({"slices": {name: after[name] for name in after if after[name] is not before[name]}}))
    return found


def follow(page: Page, texts: list[str], names: Any) -> Any:
    return page.evaluate(FOLLOWING, [texts, list(names)])


@pytest.mark.slow
def test_the_copy_is_the_servers_state_after_every_message(blank: Page) -> None:
    for seed in range(8):
        states = random_states(seed, 80)
        texts = texts_of(states)
        assert any('"changes"' in text for text in texts)
        for state, text, (taken, seen, heard) in zip(states, texts, follow(blank, texts, states[0]), strict=True):
            assert taken
            assert seen == state
            message = json.loads(text)
            assert sorted(heard) == sorted([*message["slices"], *message.get("changes", {})])


def test_after_a_missed_message_nothing_is_applied_until_all_slices_arrive(blank: Page) -> None:
    states = random_states(1, 60)
    texts = texts_of(states)
    anew = texts_of([states[-1]])
    seen = follow(blank, [*texts[:20], *texts[21:], *anew], states[0])
    assert [taken for taken, _, _ in seen] == [True] * 20 + [False] * 40 + [True]
    assert seen[-2][1] == states[19]
    assert seen[-1][1] == states[-1]


def test_slices_missing_from_the_first_message_are_removed(blank: Page) -> None:
    texts = ['{"slices": {"a": 1, "b": 2}, "version": 1}', '{"slices": {"b": 3}, "version": 1}']
    *_, (taken, seen, heard) = follow(blank, texts, "ab")
    assert (taken, seen, sorted(heard)) == (True, {"a": None, "b": 3}, ["a", "b"])


@pytest.mark.parametrize(
    "change", ['{"order": ["9"]}', '{"order": []}', '{"in": {"c": {"set": {"d": 1}}}}'], ids=["other", "fewer", "inner"]
)
def test_a_change_that_does_not_fit_is_not_applied(blank: Page, change: str) -> None:
    whole = '{"slices": {"a": {"b": 1}, "list": [{"id": "1"}]}, "version": 1}'
    name = "list" if "order" in change else "a"
    strange = f'{{"slices": {{"z": 1}}, "changes": {{"{name}": {change}}}, "version": 2}}'
    _, (taken, seen, heard) = follow(blank, [whole, strange], ["a", "list", "z"])
    assert (taken, heard) == (False, [])
    assert seen == {"a": {"b": 1}, "list": [{"id": "1"}], "z": None}


def test_what_did_not_change_stays_the_same_object(blank: Page) -> None:
    assert blank.evaluate("""async () => {
      const { changed } = await import('/js/net/delta.js');
      const before = [{ id: 'a' }, { id: 'b' }, { n: 3 }];
      const after = changed(before, { set: [{ id: 'b', on: true }] });
      return after[0] === before[0] && after[2] === before[2] && after[1].on && before[1].on === undefined;
    }""")
