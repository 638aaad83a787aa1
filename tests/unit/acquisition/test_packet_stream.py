"""A lidar that sends packets, by real sockets on this machine: recordings replayed, two senders, none."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("embreex", reason="the simulator needs the extra `simulate`")

from ladarreg_core.acquisition.devices.packet_stream import PacketStream
from ladarreg_core.acquisition.interfaces import Arrival, PanTilt
from ladarreg_core.acquisition.runs.run_folder import ScanPiece
from ladarreg_core.acquisition.simulated.lidar_twin import LidarTwin, VelodyneOnBench
from ladarreg_core.acquisition.simulated.world import FRAME_MOUNT, Bench
from ladarreg_core.errors import Cancelled, DeviceError
from ladarreg_core.formats import read_scan
from testing.devices.runs import recorded_pieces
from testing.files.ouster_recordings import write_ouster_recording

Connect = Callable[..., PacketStream]


@pytest.fixture
def connect() -> Iterator[Connect]:
    """Listens on a free port, and closes it at the end."""
    with ExitStack() as stack:

        def connected_to(**options: object) -> PacketStream:
            given = {"is_readable": read_scan, "timeout_s": 20.0, **options}
            source = PacketStream(0, **given)  # type: ignore[arg-type]
            stack.callback(source.close)
            return source

        yield connected_to


def _no_check() -> None:
    return


def test_an_ouster_recording_is_what_a_reader_of_its_file_gets(connect: Connect, tmp_path: Path) -> None:
    path = write_ouster_recording(tmp_path / "a.pcap", "RNG19_RFL8_SIG16_NIR16")
    source = connect(sensor_file=path.with_suffix(".json"))
    with LidarTwin.replaying(path, seconds=0.1, port=source.port) as twin:
        twin.switch_on()
        source.arrived(Arrival(0, PanTilt(0.0, 0.0)))
        recorded = source.next_file(tmp_path / "stop", check=_no_check)
    assert recorded.with_suffix(".json").read_bytes() == path.with_suffix(".json").read_bytes()
    live, read = read_scan(recorded), read_scan(path)
    np.testing.assert_array_equal(live.points, read.points)
    np.testing.assert_array_equal(live.intensity, read.intensity)
    assert source.keep_strays(tmp_path / "strays") == []


@pytest.mark.slow
def test_a_recording_of_the_maker_is_what_a_reader_of_its_file_gets(
    connect: Connect, tmp_path: Path, real_data: Path
) -> None:
    path = real_data / "ouster_street" / "OS-0-128-U1_v2.3.0_1024x10.pcap"
    source = connect(sensor_file=path.with_suffix(".json"))
    with LidarTwin.replaying(path, seconds=0.1, port=source.port) as twin:
        twin.switch_on()
        recorded = source.next_file(tmp_path / "stop", check=_no_check)
    live, read = read_scan(recorded), read_scan(path)
    assert "missing" not in live.notes[0]
    np.testing.assert_array_equal(live.points, read.points)


def test_what_came_before_it_is_asked_for_is_thrown_away(connect: Connect, tmp_path: Path) -> None:
    bench = Bench("plain", 3)
    lidar = VelodyneOnBench(bench)
    source = connect()
    with LidarTwin(lidar.packets, seconds=0.1, port=source.port) as twin:
        twin.switch_on()
        seen = []
        for index, pan in enumerate((0.0, 0.5)):
            bench.place_unit(PanTilt(pan, 0.0))
            source.next_file(tmp_path / f"{index}-settling", check=_no_check)  # a turn that began before may follow
            scan = read_scan(source.next_file(tmp_path / str(index), check=_no_check))
            hit = scan.points[scan.valid].astype(float)
            room = bench.room_from_world @ (bench.frame_pose(PanTilt(pan, 0.0)) @ hit)
            seen.append([np.percentile(room[:, k], (0.5, 99.5)) for k in range(2)])
    np.testing.assert_allclose(seen[1], seen[0], atol=0.05)


def test_two_senders_must_be_told_apart(connect: Connect, tmp_path: Path) -> None:
    source = connect(host="127.0.0.3", timeout_s=1.0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.2", 0))

        def send() -> None:
            other.sendto(b"stray", ("127.0.0.1", source.port))

        with pytest.raises(DeviceError, match=r"nothing came from 127\.0\.0\.3 .*\(127\.0\.0\.2 sent something\)"):
            source.next_file(tmp_path, check=send)
    either = connect()
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as two,
    ):
        two.bind(("127.0.0.2", 0))

        def send_both() -> None:
            for sender in (one, two):
                sender.sendto(b"packet", ("127.0.0.1", either.port))

        with pytest.raises(DeviceError, match=r"several lidars .*127\.0\.0\.1, 127\.0\.0\.2.*'host'"):
            either.next_file(tmp_path, check=send_both)


def test_silence_and_rubbish_are_told(connect: Connect, tmp_path: Path) -> None:
    source = connect(timeout_s=0.2)
    with pytest.raises(DeviceError, match=r"nothing came on the UDP port .*firewall"):
        source.next_file(tmp_path, check=_no_check)
    with pytest.raises(DeviceError, match=f"UDP port {source.port} cannot be listened on"):
        PacketStream(source.port, is_readable=read_scan, timeout_s=1.0)
    with pytest.raises(DeviceError, match=r"address 'no\.such\.host\.invalid'.*IP address"):
        connect(host="no.such.host.invalid")
    rubbish = connect(timeout_s=0.6)
    with LidarTwin(lambda: [bytes(100)] * 10, seconds=0.05, port=rubbish.port) as twin:
        twin.switch_on()
        with pytest.raises(DeviceError, match=r"is no measurement: scan\.pcap: most of its packets have 100 bytes"):
            rubbish.next_file(tmp_path, check=_no_check)
    assert not list(tmp_path.glob("*.pcap"))

    def stop() -> None:
        raise Cancelled

    with pytest.raises(Cancelled):
        rubbish.next_file(tmp_path, check=stop)


@pytest.mark.slow  # in real time: the devices have a process of their own
def test_a_mosaic_is_recorded_from_packets(tmp_path: Path) -> None:
    at = "?seed=3&scene=plain"
    fields = {
        "version": 1,
        "unit": {"port": f"twin:flir-ptu{at}", "baud": 115200},
        "scanner": {"kind": "packets", "host": f"twin:velodyne{at}", "timeout_s": 120},
        "mode": "mosaic",
        "pan_deg": [0, 40, 40],
        "mount": {"xyz_m": FRAME_MOUNT.translation.tolist(), "rpy_deg": [0, 0, 0]},
    }
    bench = Bench("plain", 3)
    pieces = recorded_pieces(fields, tmp_path / "run")
    assert len(pieces) == 2
    for piece in pieces:
        assert isinstance(piece, ScanPiece)
        assert piece.scan.shape[0] == 16
        far = piece.scan.valid & (piece.scan.ranges > 1.0)
        true = bench.scan_frame(piece.at, piece.scan.geometry, noise_key=(1,))
        off = np.abs(piece.scan.ranges - true.ranges)[far & true.valid]
        assert np.median(off) < 0.02, "but for where each beam begins, and noise"
