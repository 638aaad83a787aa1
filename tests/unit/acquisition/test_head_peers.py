"""Pelco-D and ONVIF compared with implementations that were written from the documents without reading ours."""

from __future__ import annotations

import contextlib
import math
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from ladarreg_core.acquisition.devices import onvif_protocol, pelco_protocol
from ladarreg_core.acquisition.devices.onvif_link import OnvifLink
from ladarreg_core.acquisition.devices.onvif_protocol import (
    OnvifError,
    OnvifRefusalError,
    Vector,
    absolute_move,
    device_time,
    of_profile,
    ptz_nodes,
    ptz_profiles,
    ptz_status,
)
from ladarreg_core.acquisition.devices.pelco_protocol import Axis, PelcoError, parse_position, query_position
from ladarreg_core.acquisition.simulated.flir_twin import FlirTwin
from ladarreg_core.acquisition.simulated.onvif_twin import OnvifTwin
from ladarreg_core.acquisition.simulated.pelco_twin import PelcoTwin
from testing.devices import onvif_peer, pelco_peer
from testing.devices.onvif_peer import PeerPtz
from testing.devices.pelco_peer import PeerHead
from testing.devices.simulated_clock import SimulatedClock
from tests.unit.acquisition.test_protocol_peers import EXCHANGES, damaged, parts

AXES: tuple[Axis, Axis] = ("pan", "tilt")
OPCODES = {"pan": 0x59, "tilt": 0x5B}


# -- Pelco-D -----------------------------------------------------------------------------------------------------------


def test_both_have_the_examples_of_the_manual() -> None:
    """45 deg below the horizon is 4500, 30 deg above it 33000; pan 45 is 4500."""
    assert pelco_protocol.set_position("tilt", 1, -4500) == pelco_peer.message(1, 0, 0x4D, 4500)
    assert pelco_protocol.set_position("tilt", 1, 3000) == pelco_peer.message(1, 0, 0x4D, 33_000)
    assert pelco_protocol.set_position("pan", 1, -4500) == pelco_peer.message(1, 0, 0x4B, 4500)
    assert pelco_peer.tilt_above_horizon(4500) == -45
    assert pelco_peer.tilt_above_horizon(33_000) == 30
    assert pelco_protocol.stop(7) == b"\xff\x07\x00\x00\x00\x00\x07"


@parts
def test_exchanges_with_a_head_are_read_alike(part: int) -> None:
    rng = np.random.default_rng([45, part])
    refused = taken = 0
    for _ in range(EXCHANGES):
        address = int(rng.integers(1, 256))
        head = PeerHead(address, responds=bool(rng.random() < 0.7), alarms=int(rng.integers(0, 4)))
        axis = AXES[int(rng.integers(2))]
        steps = int(rng.integers(-18_000, 18_000) if axis == "pan" else rng.integers(-9000, 9001))
        before = (head.pan, head.tilt)
        acknowledged = head.answer(pelco_protocol.set_position(axis, address, steps))
        assert not pelco_peer.positions_in(acknowledged, address)
        assert (head.tilt if axis == "pan" else head.pan) == before[axis == "pan"], "the other axis stays"
        if axis == "tilt":
            assert pelco_peer.tilt_above_horizon(head.tilt) == pytest.approx(steps / 100)
        sent = query_position(axis, address)
        assert PeerHead(address % 255 + 1).answer(sent) == b"", "another head on the line"
        late = acknowledged if rng.random() < 0.5 else b""  # of the command before, or an adapter's echo
        reply = late + (sent if rng.random() < 0.2 else b"") + head.answer(sent)
        ((opcode, value),) = pelco_peer.positions_in(reply, address)
        assert opcode == OPCODES[axis]
        assert pelco_protocol.response_end(reply, axis, address) == len(reply)
        found = parse_position(reply, axis, address)
        assert found == steps
        assert -found % 36_000 == value
        halts = head.halts
        head.answer(pelco_protocol.stop(address))
        assert head.halts == halts + 1
        bad = damaged(reply, rng)
        theirs = [each for code, each in pelco_peer.positions_in(bad, address) if code == OPCODES[axis]]
        try:
            ours = parse_position(bad, axis, address)
        except PelcoError:
            refused += 1
            # Ours refuses positions that no axis can have, too; the reader of the document takes all numbers.
            assert not theirs or theirs[0] >= 36_000 or axis == "tilt"
        else:
            taken += 1
            assert -ours % 36_000 == theirs[0], (reply, bad)
    assert refused > EXCHANGES // 4, "damage"
    assert taken > EXCHANGES // 20, "damage of what comes before the response"


def test_the_simulated_head_answers_as_the_manual_says() -> None:
    rng = np.random.default_rng(45)
    unit = FlirTwin()
    twin, peer = PelcoTwin(unit, address=9), PeerHead(9)
    now = 0.0
    for _ in range(60):
        axis = AXES[int(rng.integers(2))]
        steps = int(rng.integers(-16_000, 16_000) if axis == "pan" else rng.integers(-4500, 3000))
        command = pelco_protocol.set_position(axis, 9, steps)
        for device in (twin.feed, lambda data, _: peer.answer(data)):
            device(command, now)
        now += 30.0
        assert twin.due(now) == peer.answer(command), "the general response"
        query = query_position(axis, 9)
        twin.feed(query, now)
        now += 1.0
        ((_, value),) = pelco_peer.positions_in(twin.due(now), 9)
        ((_, wanted),) = pelco_peer.positions_in(peer.answer(query), 9)
        assert abs((value - wanted + 18_000) % 36_000 - 18_000) <= 1, "the steps of its motors are .013 deg"
    unit.go_to("P", 2.0, now)
    twin.feed(pelco_peer.message(9, 0, 0, 0), now + 0.5)
    assert not unit.moving(now + 0.51)
    damaged_query = bytearray(query_position("pan", 9))
    damaged_query[-1] ^= 1
    twin.feed(bytes(damaged_query), now + 1)
    twin.feed(query_position("pan", 8), now + 1)
    now += 2
    assert twin.due(now) == peer.answer(pelco_peer.message(9, 0, 0, 0)), "nothing but the answer to the stop"


# -- ONVIF -------------------------------------------------------------------------------------------------------------


def drawn_device(rng: np.random.Generator) -> PeerPtz:
    prefixes = (("s", "tt", "p"), ("SOAP-ENV", "", "tptz"), ("env", "schema", "ns1"), ("e", "tt", "tt2"))
    half = float(rng.uniform(30, 180))
    low = float(rng.uniform(-90, -10))
    degrees = (-half, half, low, float(rng.uniform(low + 20, 90)))
    has_degrees = bool(rng.random() < 0.7)
    return PeerPtz(
        user="op & <co>" if rng.random() < 0.5 else "", password="påss w&rd",
        clock=datetime(2001, 1, 1) + timedelta(seconds=int(rng.integers(10**9))),
        profile=f"P_{rng.integers(1000)} <&>", prefixes=prefixes[int(rng.integers(4))],
        gap=("", "\n  ", "\r\n\t")[int(rng.integers(3))], degrees=degrees if has_degrees else None,
        default_space=onvif_peer.DEGREES if has_degrees and rng.random() < 0.6 else onvif_peer.GENERIC,
        has_move_status=bool(rng.random() < 0.8), x=float(rng.uniform(-1, 1)), y=float(rng.uniform(-1, 1)),
        moving=("IDLE", "MOVING", "UNKNOWN")[int(rng.integers(3))],
    )  # fmt: skip


def link_to(peer: PeerPtz, password: str | None = None) -> OnvifLink:
    def send(url: str, body: bytes, deadline_s: float) -> tuple[int, bytes]:
        return peer.answer(body)

    return OnvifLink(
        "http://192.168.1.9/onvif/device_service", peer.user, clock=SimulatedClock(), send=send,
        password=peer.password if password is None else password,
    )  # fmt: skip


@parts
def test_exchanges_with_a_device_are_read_alike(part: int) -> None:
    rng = np.random.default_rng([46, part])
    done = refused = taken = 0
    while done < EXCHANGES:
        peer = drawn_device(rng)
        link = link_to(peer)
        (profile,) = ptz_profiles(link.ask("media", "GetProfiles"))
        assert (profile.token, profile.node, profile.space) == (peer.profile, "Node", peer.default_space)
        node = ptz_nodes(link.ask("ptz", "GetNodes"))["Node"]
        assert node.positions[onvif_protocol.GENERIC] == ((-1, 1), (-1, 1))
        stated = node.positions.get(onvif_protocol.DEGREES)
        assert stated == (None if peer.degrees is None else (peer.degrees[:2], peer.degrees[2:]))
        done += 3
        for _ in range(20):
            done += 2
            space = onvif_protocol.DEGREES if stated and rng.random() < 0.7 else onvif_protocol.GENERIC
            ranges = node.positions[space]
            to = Vector(float(rng.uniform(*ranges[0])), float(rng.uniform(*ranges[1])), space)
            speed = float(rng.uniform(0.1, 80)) if stated and rng.random() < 0.5 else None
            link.ask("ptz", "AbsoluteMove", absolute_move(profile.token, to, speed_deg_s=speed))
            at = peer.in_degrees() if space == onvif_protocol.DEGREES else (peer.x, peer.y)
            assert at == pytest.approx((to.x, to.y), abs=2e-6)
            assert (peer.last_speed is None) == (speed is None)
            if speed is not None and peer.last_speed is not None:
                assert peer.last_speed[:2] == pytest.approx((speed, speed), abs=1e-6)
                assert peer.last_speed[2] == onvif_peer.SPEED_DEGREES
            request = onvif_protocol.request("ptz", "GetStatus", of_profile(profile.token))
            peer_user, peer.user = peer.user, ""
            _, data = peer.answer(request)
            peer.user = peer_user
            status = ptz_status(onvif_protocol.answer(data, "ptz", "GetStatus"), profile.space)
            x, y, stated_in, moves = onvif_peer.status_in(data)
            assert status.position == Vector(x, y, stated_in)
            assert status.moves == {"MOVING": True, "IDLE": False}.get(moves or "")
            bad = damaged(data, rng)
            theirs = None
            with contextlib.suppress(Exception):  # of a DOM that is given damaged XML: whatever it is
                theirs = onvif_peer.status_in(bad)
            try:
                ours = ptz_status(onvif_protocol.answer(bad, "ptz", "GetStatus"), profile.space)
            except (OnvifError, OnvifRefusalError):
                refused += 1
                continue
            if theirs is not None and ours.position is not None:
                taken += 1
                assert (ours.position.x, ours.position.y) == theirs[:2], bad
        stops = peer.stops
        link.ask("ptz", "Stop", onvif_protocol.stop(profile.token))
        assert peer.stops == stops + 1
    assert refused > EXCHANGES // 20
    assert taken > EXCHANGES // 20


def test_a_request_is_signed_as_the_profile_says() -> None:
    peer = PeerPtz(user="admin", password="geheim")
    link_to(peer).ask("media", "GetProfiles")
    with pytest.raises(OnvifRefusalError, match=r"refused GetServices: Sender NotAuthorized .*LADARREG_ONVIF_PASSWORD"):
        link_to(peer, "falsch")
    assert device_time(
        onvif_protocol.answer(
            peer.answer(onvif_protocol.request("device", "GetSystemDateAndTime"))[1], "device", "GetSystemDateAndTime"
        )
    ) == peer.clock.replace(tzinfo=UTC)


def test_the_time_is_asked_again_when_the_clock_of_the_device_was_set() -> None:
    peer = PeerPtz(user="admin", password="geheim")
    link = link_to(peer)
    peer.clock += timedelta(days=9000)
    assert ptz_profiles(link.ask("media", "GetProfiles"))


def test_services_are_reached_where_the_device_was() -> None:
    asked = []
    peer = PeerPtz()

    def send(url: str, body: bytes, deadline_s: float) -> tuple[int, bytes]:
        asked.append(url)
        return peer.answer(body)

    link = OnvifLink("http://example.net:81/dev", "", clock=SimulatedClock(), send=send, password="")
    link.ask("media", "GetProfiles")
    link.ask("ptz", "GetNodes")
    assert asked[-2:] == ["http://example.net:81/m", "http://example.net:81/ptz"], "and not where it says it is"


def test_the_simulated_device_answers_as_the_specification_says() -> None:
    unit = FlirTwin()
    for has_degrees in (True, False):
        twin = OnvifTwin(unit, has_degrees=has_degrees)
        now = 0.0
        rng = np.random.default_rng(46)
        (left, right), (low, high) = ((-168, 168), (-46.5, 30.9)) if has_degrees else ((-1, 1), (-1, 1))
        space = onvif_peer.DEGREES if has_degrees else onvif_peer.GENERIC
        for _ in range(30):
            x, y = float(rng.uniform(left, right)), float(rng.uniform(low, high))
            move = onvif_protocol.request(
                "ptz", "AbsoluteMove", absolute_move("Profile_1", Vector(x, y, space), speed_deg_s=None)
            )
            answered = twin.answer(move, now)
            assert answered is not None
            assert answered[0] == 200
            _, data = twin.answer(onvif_protocol.request("ptz", "GetStatus", of_profile("Profile_1")), now + 0.1)
            assert onvif_peer.status_in(data)[3] == "MOVING"
            now += 60.0
            _, data = twin.answer(onvif_protocol.request("ptz", "GetStatus", of_profile("Profile_1")), now)
            found = onvif_peer.status_in(data)
            assert found[:2] == pytest.approx((x, y), abs=0.01 if has_degrees else 3e-4)
            assert found[2:] == (space, "IDLE")
            pan, tilt = np.degrees(unit.angles_at([now])[0])
            if has_degrees:  # the picture's content moves to the left as X grows, and down as Y does
                assert (pan, tilt) == pytest.approx((-x, y), abs=0.01)
        status, data = twin.answer(
            onvif_protocol.request(
                "ptz", "AbsoluteMove", absolute_move("Profile_1", Vector(-400, 0, space), speed_deg_s=None)
            ),
            now,
        )
        assert status == 400
        with pytest.raises(OnvifRefusalError, match="InvalidPosition"):
            onvif_protocol.answer(data, "ptz", "AbsoluteMove")


@pytest.mark.parametrize(
    "data",
    [
        b"", b"<html><body>Login</body></html>", b"\xff\xfe\x00", b"<a>" * 200,
        b'<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a "aaaa">]><x>&a;</x>',
    ],
)  # fmt: skip
def test_what_is_no_answer_is_refused(data: bytes) -> None:
    with pytest.raises(OnvifError, match="in answer to GetStatus"):
        onvif_protocol.answer(data, "ptz", "GetStatus")


def test_numbers_as_xml_has_them() -> None:
    peer = PeerPtz(degrees=(-math.inf, math.inf, -90.0, 20.0))
    _, data = peer.answer(onvif_protocol.request("ptz", "GetNodes"))
    data = data.replace(b"-inf", b"-INF").replace(b">inf", b">INF")
    node = ptz_nodes(onvif_protocol.answer(data, "ptz", "GetNodes"))["Node"]
    assert node.positions[onvif_protocol.DEGREES] == ((-math.inf, math.inf), (-90.0, 20.0))
