"""Random edits of slices, for the tests of deltas on both sides."""

from __future__ import annotations

import random
from typing import Any


def random_states(seed: int, count: int) -> list[dict[str, Any]]:
    """Return successive states: lists with ids, objects by id, and values with neither."""
    rng = random.Random(seed)
    state: dict[str, Any] = {"picks:p1": [], "judged:p1": {"stage": None, "by_pick": {}, "losses": []}, "name": "a"}
    state["history"] = {"at": 0, "entries": []}
    states = [dict(state)]
    for n in range(count):
        for _ in range(rng.choice((1, 1, 1, 40))):
            name = rng.choice(list(_EDITS))
            state = state | {name: _EDITS[name](rng, state.get(name), n)}
        states.append(state)
    return states


def _picks(rng: random.Random, picks: list[Any] | None, n: int) -> list[Any] | None:
    picks = list(picks or [])
    what = rng.random()
    if what < 0.5 or len(picks) < 3:
        picks.insert(rng.choice((len(picks), rng.randrange(len(picks) + 1))), _pick(rng, str(rng.randrange(10**6))))
    elif what < 0.75:
        k = rng.randrange(len(picks))
        picks[k] = _pick(rng, picks[k]["id"])
    elif what < 0.9:
        del picks[rng.randrange(len(picks))]
    elif what < 0.97:
        rng.shuffle(picks)
    else:
        return None
    ids = [pick["id"] for pick in picks]
    return [pick for k, pick in enumerate(picks) if pick["id"] not in ids[:k]]


def _pick(rng: random.Random, name: str) -> dict[str, Any]:
    return {"id": name, "photo": [[rng.random(), rng.random()]], "on": rng.random() < 0.5}


def _judged(rng: random.Random, judged: dict[str, Any] | None, n: int) -> dict[str, Any] | None:
    if rng.random() < 0.03:
        return None
    judged = dict(judged or {"by_pick": {}, "losses": []})
    by_pick = dict(judged["by_pick"])
    by_pick[str(rng.randrange(60))] = {"px": rng.choice((None, rng.random()))}
    if rng.random() < 0.3:
        by_pick.pop(rng.choice(list(by_pick)))
    judged["by_pick"] = by_pick
    if rng.random() < 0.2:
        judged["losses"] = [f"Match {n} is left out."]
    if rng.random() < 0.1:
        judged["stage"] = rng.choice((None, "robust"))
    if rng.random() < 0.1:
        judged.pop("extra", None) if "extra" in judged else judged.update(extra=n)
    return judged


def _history(rng: random.Random, history: dict[str, Any] | None, n: int) -> dict[str, Any]:
    entries = list((history or {"entries": []})["entries"])
    entries = entries[: rng.choice((len(entries), len(entries), len(entries) // 2))]
    number = entries[-1]["n"] + 1 if entries else n
    entries.append({"n": number, "label": f"Move {n}"})
    return {"at": number, "entries": entries[-50:]}


def _name(rng: random.Random, name: str | None, n: int) -> str | None:
    return rng.choice((None, "a", f"b{n}"))


_EDITS = {"picks:p1": _picks, "judged:p1": _judged, "history": _history, "name": _name}
