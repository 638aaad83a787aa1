"""The document's websocket: complete first, always up to date, and no client waits for a slow one."""

from __future__ import annotations

import contextlib
import gzip
import json
import math
import socket
import struct
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from ladarreg.gateway.document_socket import ClientState, Outbox
from ladarreg.gateway.encoding import InvalidMessageError, SharedEncoder, decode_object, encode
from websockets.exceptions import ConnectionClosed

from testing.workbench.gateway_driver import LOOK_TOKEN, TOKEN, Running, closing_code, hear, running, soon


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    with running(tmp_path_factory.mktemp("room")) as found:
        yield found


def narrow_line(run: Running) -> socket.socket:
    """Connect with a small receive buffer."""
    line = socket.socket()
    line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 15)
    line.connect(("127.0.0.1", run.port))
    return line


def reply(page: Any) -> dict[str, Any]:
    """Return the next reply, skipping changes."""
    while "reply" not in (message := hear(page)):
        pass
    return message


def test_a_client_receives_everything_first_and_then_the_changes(run: Running) -> None:
    with run.socket() as first, run.socket() as second:
        everything = hear(first)
        told = everything["slices"]
        assert {"number", "people", "scan"} <= set(told)
        other = hear(second)["slices"]
        assert told["people"]["you"] != other["people"]["you"]
        number = run.bench.number + 1
        first.send(json.dumps({"id": 7, "do": "set", "number": number}))
        news = hear(first)
        answer = news if "reply" in news else hear(first)  # on a busy machine, the changes do not wait for it
        assert news["slices"]["number"] == number
        assert (everything["version"], news["version"]) == (1, 2), "a client that missed a message would notice"
        assert answer["reply"] == 7, "the reply follows the changes that it caused"
        assert answer["nan"] is None, "JSON has no NaN"
        assert hear(second)["slices"] == {"number": number}
        run.bench.tell({"event": "notice", "level": "warn", "text": "<b>"})
        assert hear(first) == hear(second) == {"event": "notice", "level": "warn", "text": "<b>"}
    assert soon(lambda: not run.bench.pages)
    assert soon(lambda: not run.bench.listeners)


def test_a_page_that_asks_for_it_receives_a_long_first_message_compressed(run: Running) -> None:
    number = run.bench.number
    long = 20_000 * "ä"
    with run.socket("/document?packed=gzip") as page:
        assert isinstance(page.recv(timeout=60), str), "a short one is not worth it"
        page.send(json.dumps({"id": 1, "do": "set", "number": long}))
        while "reply" not in json.loads(page.recv(timeout=60)):
            pass
    with run.socket("/document?packed=gzip") as page, run.socket() as other:
        packed = page.recv(timeout=60)
        assert isinstance(packed, bytes)
        assert len(packed) < 2000
        assert json.loads(gzip.decompress(packed))["slices"]["number"] == hear(other)["slices"]["number"] == long
        page.send(json.dumps({"id": 2, "do": "set", "number": number}))
        assert isinstance(page.recv(timeout=60), str), "only the first message is"


HOSTILE = (
    "", "{", '{"id": 1, "do"', "[1]", "null", "7", "NaN", '{"id": 1,}', "\x00", "[" * 5000, '{"a":' * 5000,
    '{"id": 1e999}', b"\xff\xfe", b'{"id": 1, "do": "set", "number": 1}',
)  # fmt: skip


def test_malformed_messages_are_answered_and_the_connection_stays(run: Running) -> None:
    with run.socket() as page:
        hear(page)
        for text in HOSTILE:
            page.send(text)
            answer = reply(page)
            assert answer["ok"] is False
            assert answer["reply"] is None
        page.send('{"id": 8, "do": "look"}')
        assert reply(page)["ok"] is True


def test_an_internal_error_is_reported_without_details(run: Running) -> None:
    with run.socket() as page:
        hear(page)
        page.send('{"id": 3, "do": "fail"}')
        answer = reply(page)
        assert (answer["reply"], answer["ok"]) == (3, False)
        assert "secret" not in answer["error"]
        assert "Traceback" not in answer["error"]
        page.send('{"do": "look"}')
        assert reply(page)["reply"] is None


def test_a_message_that_is_too_long_closes_only_its_connection(run: Running) -> None:
    with run.socket() as page, run.socket() as other:
        hear(page)
        hear(other)
        page.send(json.dumps({"id": 1, "do": "look", "x": "a" * 900_000}))
        assert reply(page)["ok"] is True
        page.send(json.dumps({"id": 2, "do": "look", "x": "a" * 1_100_000}))
        with pytest.raises(ConnectionClosed) as caught:
            reply(page)
        assert caught.value.rcvd is not None
        assert caught.value.rcvd.code == 1009
        other.send('{"id": 1, "do": "look"}')
        assert reply(other)["ok"] is True


@pytest.mark.parametrize(("token", "most"), [(TOKEN, 1_000_000), (LOOK_TOKEN, 65_536)])
@pytest.mark.parametrize("pieces", [1, 4])
def test_the_length_of_a_message_counts_while_it_arrives(run: Running, token: str, most: int, pieces: int) -> None:
    """Who begins a long message is refused before it is sent, whole or in fragments."""
    own = run.access
    run.enter(token)
    try:
        with run.socket() as page:
            hear(page)
            page.send(json.dumps({"id": 1, "do": "look", "x": "a" * (most - 100)}))
            assert reply(page)["ok"] is True
            share = most // pieces + 1
            frames = [(0x1 if k == 0 else 0x0, share) for k in range(pieces)]
            for opcode, length in frames[:-1]:
                page.socket.sendall(frame_begin(opcode, length) + bytes(length))
            page.socket.sendall(frame_begin(frames[-1][0], frames[-1][1]))  # and nothing of the content
            assert closing_code(page) == 1009
    finally:
        run.access = own


def frame_begin(opcode: int, length: int) -> bytes:
    """Return the head of a masked frame that is not the last one of its message."""
    return struct.pack("!BBQ", opcode, 0x80 | 127, length) + bytes(4)


def test_replies_keep_the_order_of_the_commands(run: Running) -> None:
    with run.socket() as page:
        hear(page)
        for number in range(200):
            page.send(json.dumps({"id": number, "do": "set", "number": number}))
        assert [reply(page)["reply"] for _ in range(200)] == list(range(200))


def test_stopping_waits_for_no_command_and_no_thread_and_is_answered_in_its_turn(run: Running) -> None:
    run.bench.done.clear()
    run.bench.slow.clear()
    pages = [run.socket() for _ in range(45)]  # more than the threads that other requests share
    try:
        for number, page in enumerate(pages):
            page.send(json.dumps({"id": number, "do": "slow"}))
        page = pages[0]
        page.send('{"id": "look", "do": "look"}')
        page.send('{"id": "stop", "do": "acquire_stop"}')
        assert soon(lambda: "acquire_stop" in run.bench.done)
        assert "slow" not in run.bench.done
        assert "look" not in run.bench.done
        run.bench.slow.set()
        assert [reply(page)["reply"] for _ in range(3)] == [0, "look", "stop"]
        assert run.bench.done.count("acquire_stop") == 1
    finally:
        run.bench.slow.set()
        for page in pages:
            page.close()
    assert soon(lambda: not run.bench.pages)


def test_only_the_command_itself_is_urgent(run: Running) -> None:
    run.bench.done.clear()
    run.bench.slow.clear()
    with run.socket() as page:
        page.send('{"id": 1, "do": "slow"}')
        page.send('{"id": 2, "do": "set", "number": 5, "name": "acquire_stop"}')
        page.send('{"id": 3, "do": "acquire_stop"}')
        assert soon(lambda: run.bench.done == ["acquire_stop"])
        run.bench.slow.set()
        assert [reply(page)["reply"] for _ in range(3)] == [1, 2, 3]


def test_ten_clients_see_one_state(run: Running) -> None:
    pages = [run.socket() for _ in range(10)]
    try:
        for page in pages:
            hear(page)
        for n, page in enumerate(pages):
            page.send(json.dumps({"id": n, "do": "set", "number": 1000 + n}))
        for page in pages:
            reply(page)
        run.bench.tell({"slices": {"number": "last"}, "version": 0})
        for page in pages:
            while hear(page).get("slices", {}).get("number") != "last":
                pass
    finally:
        for page in pages:
            page.close()
    assert soon(lambda: not run.bench.pages)


def test_a_slow_client_delays_no_other_and_gets_the_latest_state(run: Running) -> None:
    """Its socket buffers a few kilobytes, and thirty megabytes are published meanwhile."""
    narrow = narrow_line(run)
    with run.socket(sock=narrow, max_queue=1) as slow, run.socket() as quick:
        hear(quick)
        big = "x" * 100_000
        for n in range(300):
            run.bench.tell({"slices": {"big": [n, big]}, "version": n})
            run.bench.tell({"event": "simplex", "iteration": n})
            while hear(quick).get("slices", {}).get("big", [None])[0] != n:
                pass
        heard = []
        while not heard or heard[-1].get("event") != "simplex" or heard[-1]["iteration"] != 299:
            heard.append(hear(slow))
        assert len(heard) < 300
        assert [m["slices"]["big"][0] for m in heard if "big" in m.get("slices", {})][-1] == 299


@pytest.mark.slow
def test_a_client_that_reads_no_replies_is_not_read_further(run: Running) -> None:
    line, before = narrow_line(run), run.bench.version
    with run.socket(sock=line, max_queue=1) as page:
        command = json.dumps({"id": "x" * 200_000, "do": "set", "number": 0})

        def flood() -> None:
            with contextlib.suppress(OSError, ConnectionClosed):
                for _ in range(400):
                    page.send(command)

        flooding = threading.Thread(target=flood, daemon=True)
        flooding.start()
        flooding.join(timeout=2.0)
        assert flooding.is_alive(), "80 MB of commands are waiting, unread"
        assert 0 < run.bench.version - before < 200
        line.shutdown(socket.SHUT_RDWR)
        flooding.join(timeout=5.0)
    assert soon(lambda: not run.bench.pages)


SLICES = st.fixed_dictionaries(
    {"slices": st.dictionaries(st.sampled_from("abc"), st.integers()), "version": st.integers()}
)
EVENTS = st.fixed_dictionaries({"event": st.sampled_from(["simplex", "notice", "hover"]), "value": st.integers()})
MESSAGES = st.lists(st.one_of(SLICES, EVENTS, st.none()), max_size=60)


@given(MESSAGES)
def test_emptying_the_outbox_yields_the_latest_state(messages: list[dict[str, Any] | None]) -> None:
    woken, told, truth = [], {}, {}
    outbox = Outbox(lambda: woken.append(1))
    notices, last = [], {}

    def empty() -> None:
        for message in outbox.take()[0]:
            told.update(message.get("slices", {}))
            if message.get("event") == "notice":
                notices.append(message)
            elif "event" in message:
                last[message["event"]] = message

    for message in messages:
        if message is None:
            empty()
            assert told == truth
            assert outbox.take() == ([], None)
            continue
        calls = len(woken)
        waits = bool(outbox._slices or outbox._events or outbox._latest)
        outbox.put(message)
        truth.update(message.get("slices", {}))
        assert waits or len(woken) == calls + 1
    empty()
    assert told == truth
    assert notices == [m for m in messages if m and m.get("event") == "notice"]
    for name in ("simplex", "hover"):
        of_name = [m for m in messages if m and m.get("event") == name]
        assert last.get(name) == (of_name[-1] if of_name else None)


def test_the_changes_by_a_command_leave_together_with_its_reply() -> None:
    woken: list[int] = []
    outbox = Outbox(lambda: woken.append(1))
    outbox.hold()
    outbox.put({"slices": {"scan": 1}})
    assert not woken
    outbox.reply("done")
    assert len(woken) == 1
    assert outbox.take() == ([{"slices": {"scan": 1}}], "done")
    outbox.put({"slices": {"scan": 2}})  # nothing holds it any more
    assert len(woken) == 2
    outbox.take()

    outbox.hold()  # of a command that takes long, the changes do not wait
    outbox.put({"slices": {"scan": 3}})
    outbox.release()
    assert len(woken) == 3
    assert outbox.take() == ([{"slices": {"scan": 3}}], None)
    outbox.put({"slices": {"scan": 4}})
    assert len(woken) == 4
    outbox.release()
    assert len(woken) == 4


def test_the_changes_and_the_reply_that_follows_them_are_one_message() -> None:
    state, reply = ClientState(SharedEncoder()), '{"reply":7,"ok":true}'
    (text,) = state.encode_all([{"slices": {"scan": 1}}], reply)
    assert json.loads(text) == {"reply": 7, "ok": True, "slices": {"scan": 1}, "version": 1}
    assert state.encode_all([], reply) == [reply]
    assert [json.loads(text) for text in state.encode_all([{"slices": {"scan": 2}}], None)] == [
        {"slices": {"scan": 2}, "version": 2}
    ]
    event = {"event": "notice", "text": "saved"}
    *others, last = state.encode_all([{"slices": {"scan": 3}}, event], reply)
    assert [json.loads(text) for text in others] == [{"slices": {"scan": 3}, "version": 3}, event]
    assert last == reply, "the reply follows the event that the command caused"


def test_the_outbox_keeps_only_the_last_events() -> None:
    outbox = Outbox(lambda: None)
    for n in range(10_000):
        outbox.put({"event": "notice", "n": n})
    assert [message["n"] for message in outbox.take()[0]] == list(range(9800, 10_000))


NUMBERS = st.integers(-(2**53), 2**53) | st.floats(allow_nan=False, allow_infinity=False)
JSON = st.recursive(
    st.none() | st.booleans() | NUMBERS | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=8,
)


@pytest.mark.slow
@given(st.dictionaries(st.text(), JSON))
def test_encoding_and_decoding_agree(message: dict[str, Any]) -> None:
    assert decode_object(encode(message)) == json.loads(encode(message)) == message


@given(st.text() | JSON.filter(lambda value: not isinstance(value, dict)).map(json.dumps))
def test_text_that_is_not_an_object_is_refused(text: str) -> None:
    with pytest.raises(InvalidMessageError):
        decode_object(text)


def test_arrays_become_lists_and_non_finite_numbers_null() -> None:
    class Array:
        def tolist(self) -> list[float]:
            return [1.0, math.nan]

    assert encode({"a": Array(), "b": math.inf}) == '{"a":[1.0,null],"b":null}'
    with pytest.raises(TypeError):
        encode({"a": object()})


def test_behind_a_proxy_the_address_is_the_browsers(tmp_path: Path) -> None:
    with (
        running(tmp_path, behind_proxy=True) as run,
        run.socket(headers={"X-Forwarded-For": "9.9.9.9, 1.2.3.4"}) as page,
    ):
        hear(page)
        assert [page.visitor.address for page in run.bench.pages] == ["1.2.3.4"]
