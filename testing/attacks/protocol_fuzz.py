"""Hostile messages over the document's websocket: random fields, impossible values, damaged JSON, long frames."""

from __future__ import annotations

import json
import random
import time
from dataclasses import dataclass, field
from typing import Any

from ladarreg.workbench.commands.registry import COMMANDS

from testing.attacks.mutations import mutated
from testing.attacks.server_process import Page, Server, ServerGone

_ANSWERED_S = 120.0
"""Time after which a reply is taken to be missing."""
_NEVER = {"export"}
"""Commands that are not sent at random because they write to local folders; they have separate tests."""
_RARE = {"remove_photo", "go_to", "set_camera", "run"}
"""Commands that remove what the other commands need, or take long."""
_FAULTS = ("Internal error", "The program failed")
_CHEAP_JOBS = ("find_corners", "linear", "robust", "simplex", "reject_outliers", "cull", "nonsense")
_HOSTILE: tuple[str, ...] = (
    "null", "true", "0", "-1", "1e308", "-1e308", "1e999", "1e-308", "NaN", "Infinity", "9" * 400, "-" + "9" * 5000,
    '""', '"\\u0000"', '"\\ud800"', '"\\u202e abc"', '"../../../etc/passwd"', '"a\\u0000b"', '"' + "x" * 20_000 + '"',
    '"' + "/a" * 3000 + '"', "[]", "{}", "[[]]", "[null]", '["1", 2]', "[" * 200 + "]" * 200, "[0, 0, 0]",
    "[[1e308, 1e308, 1e308]]", "[[1e-320, 0, 0]]", "[[0, 0, 0]]", "[[1, 0]]", "[[1e308, -1e308]]", '{"a": {"b": []}}',
    "[" + "1," * 50_000 + "1]",
)  # fmt: skip
_OTHER_FRAMES: tuple[str | bytes, ...] = (
    "", " ", "{}", "[]", "null", '"text"', "{", '{"id": 1, "do": null}', '{"id": {}, "do": "undo"}',
    '{"do": "undo"}', '{"id": 1e999, "do": "undo"}', '{"id": [], "do": ["undo"]}', "[" * 100_000, '{"a":' * 50_000,
    b"", b"\x00\xff", b'{"id": 1, "do": "undo"}', "\u0000", "x" * 900_000,
)  # fmt: skip


@dataclass
class ProtocolFindings:
    """Outcome of hostile messages."""

    messages: int = 0
    done: int = 0
    refused: int = 0
    closed: int = 0
    """Connections closed by the server, as it should for messages that are too long."""
    seconds: float = 0.0
    """Time of the slowest reply."""
    faults: list[str] = field(default_factory=list)


def fuzz_protocol(server: Server, count: int, *, seed: int) -> ProtocolFindings:
    """Send hostile messages, each after the reply to the previous one.

    Args:
        server: with a photograph at least.
        count: messages.
        seed: of all draws.
    """
    rng, found = random.Random(seed), ProtocolFindings()
    page = server.page()
    for _ in range(count):
        frame = _frame(rng, page)
        began = time.perf_counter()
        try:
            page.send(frame)
            reply = page.reply(_ANSWERED_S)
        except ServerGone:
            found.closed += 1
            page.close()
            try:
                page = server.page()
            except ServerGone as error:
                found.faults.append(f"no client can join after {_shown(frame)}: {error}")
                break
            if len(frame) < 1_000_000:
                found.faults.append(f"the connection ended by {_shown(frame)}")
            continue
        except TimeoutError:
            found.faults.append(f"no answer within {_ANSWERED_S:g} s to {_shown(frame)}")
            page.close()
            page = server.page()
            continue
        finally:
            found.messages += 1
        found.seconds = max(found.seconds, time.perf_counter() - began)
        _judge(reply, frame, found)
    page.close()
    return found


def shown_state(page: Page) -> dict[str, Any]:
    """Return what must be unchanged after a kill: the document and its history as shown to a page."""
    kept = {
        name: page.slices[name] for name in page.slices if name.startswith("picks:") or name in ("settings", "scan")
    }
    photos = [
        {name: photo[name] for name in ("id", "name", "camera") if name in photo}
        for photo in page.slices["photos"] or []
    ]
    history = [(entry["n"], entry["label"], entry["author"]) for entry in page.slices["history"]["entries"]]
    name = page.slices["project"]["name"]
    return {**kept, "photos": photos, "name": name, "history": history, "at": page.slices["history"]["at"]}


def _judge(reply: dict[str, Any], frame: str | bytes, found: ProtocolFindings) -> None:
    if reply.get("ok") is True:
        found.done += 1
        return
    found.refused += 1
    error = reply.get("error")
    if reply.get("ok") is not False or not isinstance(error, str) or not error.endswith((".", "!", "?")):
        found.faults.append(f"no answer but {str(reply)[:200]} to {_shown(frame)}")
    elif any(words in error for words in _FAULTS):
        found.faults.append(f"{error[:120]} To {_shown(frame)}")
    elif "\n" in error or len(error) > 600:
        found.faults.append(f"no sentence but {error[:200]!r} to {_shown(frame)}")


def _frame(rng: random.Random, page: Page) -> str | bytes:
    what = rng.random()
    if what < 0.05:
        return rng.choice(_OTHER_FRAMES)
    text = _message(rng, page)
    if what < 0.75:
        return text
    data = mutated(text.encode("utf-8", "surrogatepass"), seed=str(rng.random()))[:900_000]
    try:
        changed = data.decode()
    except UnicodeDecodeError:
        return data
    return text if any(name in changed for name in _NEVER) else changed


def _message(rng: random.Random, page: Page) -> str:
    do = rng.choice(sorted(set(COMMANDS) - _NEVER))
    if do in _RARE and rng.random() < 0.9:
        do = "add_pick"
    if not page.slices["photos"]:  # back to a state that can be edited
        steps = [entry["n"] for entry in page.slices["history"]["entries"]]
        return json.dumps({"id": 0, "do": "go_to", "n": rng.choice(steps)})
    likely = _likely(rng, page)
    names = _FIELDS.get(do, tuple(likely))
    if do == "set_settings":
        names = tuple(rng.sample(sorted(page.slices["settings"]), rng.choice((1, 1, 2))))
    parts = [f'"id": {rng.randrange(10**6)}', f'"do": {json.dumps(do)}']
    mode = rng.random()  # all fields valid, one of them hostile, or every second one
    hostile = set() if mode < 0.35 or not names else {rng.choice(names)}
    if mode > 0.75:
        hostile = {name for name in names if rng.random() < 0.5}
    for name in names:
        if mode > 0.75 and rng.random() < 0.12:
            continue
        value = rng.choice(_HOSTILE) if name in hostile else likely.get(name, "null")
        if name == "job" and value not in map(json.dumps, _CHEAP_JOBS):
            value = json.dumps(rng.choice(_CHEAP_JOBS))
        parts.append(f"{json.dumps(name)}: {value}")
    if rng.random() < 0.05:
        parts.append(f"{json.dumps(rng.choice(('x', '', 'photo', '__class__')))}: {rng.choice(_HOSTILE)}")
    return "{" + ", ".join(parts) + "}"


def _likely(rng: random.Random, page: Page) -> dict[str, str]:
    """Return a sensible value, as JSON, for each field that some command takes."""
    photo = page.slices.get("shown")
    picks = [pick["id"] for pick in page.slices.get(f"picks:{photo}") or []] or ["1"]
    ends = rng.choice((1, 1, 2))
    settings = page.slices.get("settings") or {}
    found: dict[str, Any] = {
        "photo": photo, "pick": rng.choice(picks), "picks": rng.sample(picks, min(len(picks), 2)),
        "kind": "point" if ends == 1 else "line",
        "scan": [[1.0, rng.uniform(-0.3, 0.3), rng.uniform(-0.2, 0.2)] for _ in range(ends)],
        "photo_uv": [[rng.uniform(0, 700), rng.uniform(0, 500)] for _ in range(ends)],
        "on": rng.random() < 0.5, "weight": rng.uniform(0.1, 5), "focal_px": rng.uniform(200, 2000),
        "focal_mm": 35.0, "sensor_mm": 36.0, "focal_35mm": 28.0, "name": rng.choice(("a name", "Ö 漢字", "x")),
        "stage": rng.choice(("robust", "linear", "auto")), "by": rng.choice(("depth", "px")),
        "above": rng.uniform(0, 9), "n": rng.randrange(20),
        "texture": rng.choice(("colour", "photo", "none")), "z_buffer": True, "light": False, "cameras": True,
        "matches": True, "path": rng.choice(("camera.json", "x", "sub/x.npz")),
        "what": rng.choice(("scan", "photo", "camera", "matches")), "side": rng.choice(("scan", "photo")), "view": 0,
        "at": [rng.uniform(0, 700), rng.uniform(0, 500)], "job": rng.choice(_CHEAP_JOBS),
        "action": rng.choice(("stop", "pause", "resume", "speed", "step")), "value": rng.uniform(0, 100),
    }  # fmt: skip
    found |= {name: shown["value"] for name, shown in settings.items()}
    return {name: json.dumps(value) for name, value in found.items()}


def _shown(frame: str | bytes) -> str:
    text = repr(frame)
    return text if len(text) < 220 else f"{text[:160]} ... ({len(frame)} long)"


_FIELDS: dict[str, tuple[str, ...]] = {
    "add_pick": ("photo", "kind", "scan", "photo_uv"),
    "set_pick": ("photo", "pick", "scan", "photo_uv", "on", "weight"),
    "remove_picks": ("photo", "picks"),
    "switch_picks": ("photo", "picks", "on"),
    "reject": ("photo", "by", "above"),
    "set_camera": ("photo", "focal_px"),
    "rename": ("name",),
    "call_me": ("name",),
    "undo": (), "redo": (), "list_served": (),
    "go_to": ("n",),
    "run": ("photo", "job"),
    "job_control": ("action", "value"),
    "open_served": ("path", "what", "photo", "scan"),
    "probe": ("at", "scan"),
}  # fmt: skip
"""Fields of the most frequent commands; others get arbitrary fields."""
