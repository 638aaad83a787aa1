"""Velodyne recordings: simulated packets against the manual's figures and an independent decoder."""

from __future__ import annotations

import base64
import zlib
from pathlib import Path

import numpy as np
import pytest

from ladarreg_core.acquisition.simulated.velodyne_packets import STRONGEST, velodyne_packets
from ladarreg_core.errors import FormatError, OptionError
from ladarreg_core.formats import read_scan
from ladarreg_core.formats.packets.capture import Datagram, write_datagrams
from ladarreg_core.formats.packets.velodyne_packet import (
    BLOCK,
    BLOCKS,
    DUAL,
    HDL_32,
    HI_RES,
    MODE_AT,
    MODELS,
    PRODUCT_AT,
    VLP_16,
)
from ladarreg_core.scan import Scan

_LAST = 0x38
_SENSORS = [(VLP_16, STRONGEST), (VLP_16, DUAL), (HI_RES, _LAST), (HDL_32, STRONGEST), (HDL_32, DUAL)]


def _box(lasers: np.ndarray, azimuth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ranges that tell laser and azimuth, 1 mm apart or more; a few rays return nothing."""
    ranges = 4.0 + 0.5 * lasers + np.round(1.5 * np.sin(azimuth) + 0.3 * np.sin(7 * azimuth), 3)
    return np.where(np.cos(50 * azimuth) > 0.98, 0.0, ranges), 7.0 * lasers + 1


def write_packets(path: Path, packets: list[bytes], *, source: bytes = b"\x0a\0\0\1") -> Path:
    with open(path, "wb") as stream:
        write_datagrams(stream, ((1.7e9 + k * 1e-3, Datagram(source, 2368, each)) for k, each in enumerate(packets)))
    return path


def seed_files(folder: Path) -> list[Path]:
    return [
        write_packets(folder / "puck.pcap", velodyne_packets(VLP_16, _box, turns=2.1)),
        write_packets(folder / "dual.pcap", velodyne_packets(HDL_32, _box, mode=DUAL, turns=2.1)),
    ]


def _recorded(path: Path, product: int, mode: int = STRONGEST, **how: float) -> Scan:
    return read_scan(write_packets(path, velodyne_packets(product, _box, mode=mode, **how)))  # type: ignore[arg-type]


@pytest.mark.parametrize(("product", "mode"), _SENSORS)
def test_a_revolution_is_a_scan(tmp_path: Path, product: int, mode: int) -> None:
    scan = _recorded(tmp_path / "a.pcap", product, mode, turns=2.5, strongest=0.5)
    model = MODELS[product]
    firings = 1e5 / model.firing_us
    assert scan.shape[0] == len(model.elevations_deg)
    assert scan.shape[1] == pytest.approx(firings, abs=2)
    points = scan.points[scan.valid].astype(float)
    row = np.broadcast_to(np.arange(scan.shape[0])[:, None], scan.shape)[scan.valid]
    laser = np.argsort(model.elevations_deg)[::-1][row]
    beam = points - np.stack([0 * points[:, 0], 0 * points[:, 0], model.heights_m[laser]], -1)
    azimuth = np.arctan2(-beam[:, 1], beam[:, 0])
    distance, reflectivity = _box(laser, azimuth)
    assert np.linalg.norm(beam, axis=-1)[distance > 0] == pytest.approx(distance[distance > 0], abs=0.004)
    elevation = np.degrees(np.arcsin(beam[:, 2] / np.linalg.norm(beam, axis=-1)))
    assert elevation == pytest.approx(np.array(model.elevations_deg)[laser], abs=1e-4)
    assert scan.intensity[scan.valid] == pytest.approx(reflectivity)
    assert scan.valid.mean() == pytest.approx(0.936, abs=0.01)
    assert scan.world_from_scanner is None


def test_the_heights_are_those_of_the_manual() -> None:
    """Table 9-1, as far as its rows tell the sign of a laser above and below the horizon."""
    rows = {-7.0: 5.1, 9.0: -6.6, -5.0: 3.7, 11.0: -8.1, -3.0: 2.2, 13.0: -9.7, -1.0: 0.7, 15.0: -11.2}
    model = MODELS[VLP_16]
    found = dict(zip(model.elevations_deg, model.heights_m * 1000, strict=True))
    assert {angle: round(found[angle], 1) for angle in rows} == rows


@pytest.mark.parametrize(("product", "mode"), _SENSORS)
def test_ten_thousand_packets_are_decoded_as_an_independent_decoder_does(
    tmp_path: Path, product: int, mode: int
) -> None:
    vd = pytest.importorskip("velodyne_decoder", reason="velodyne-decoder is not installed")
    model, cases = MODELS[product], 2
    turns = 1.0 / cases * 10_000 / len(_SENSORS) / (76 if product != HDL_32 else 181) / (2 if mode == DUAL else 1)
    for case in range(cases):
        rng = np.random.default_rng([product, mode, case])

        def measure(lasers: np.ndarray, azimuth: np.ndarray, rng: np.random.Generator = rng) -> tuple:
            return 20.0 + rng.random(azimuth.shape) * 80.0, rng.integers(1, 256, azimuth.shape).astype(float)

        packets = velodyne_packets(
            product, measure, mode=mode, turns=max(turns, 2.5), strongest=0.5, rate_hz=rng.uniform(5, 20),
            begin_deg=rng.uniform(0, 360),
        )  # fmt: skip
        scan = read_scan(write_packets(tmp_path / f"{case}.pcap", packets))
        stamped = [vd.VelodynePacket(k * 1e-3, each) for k, each in enumerate(packets)]
        theirs = vd.ScanDecoder(vd.Config()).decode(stamped, True)[1]
        theirs = theirs[theirs["return_type"] == (2 if mode in (DUAL, _LAST) else 1)]
        rings = np.argsort(np.argsort(model.elevations_deg))
        for row, laser in enumerate(np.argsort(model.elevations_deg)[::-1]):
            ring = theirs[theirs["ring"] == rings[laser]]
            ours, strength = scan.points[row].astype(float), scan.intensity[row]
            at = _place_of(strength, ring["intensity"])
            found = np.stack([ring[axis][at : at + len(ours)] for axis in "xyz"], -1)
            apart = np.linalg.norm(found - ours, axis=-1) / np.linalg.norm(ours, axis=-1)
            assert np.degrees(apart.max()) < 0.015, "azimuths are sent, and computed there, to .01 deg"
            assert np.degrees(np.abs(np.median(apart))) < 0.006


def _place_of(part: np.ndarray, whole: np.ndarray) -> int:
    """Return where a sequence of reflectivities stands in a longer one."""
    for at in range(len(whole) - len(part) + 1):
        if np.array_equal(whole[at : at + len(part)], part):
            return at
    raise AssertionError("the firings of the revolution are not among those of the other decoder")


PUBLISHED = zlib.decompress(base64.b85decode(
    "c-lRa-A~(f6vlu3e9OjebZ#+W#Kkej*3N*uwbB<_NTI;kstm9iFE!ryH~263514r8g~`;LG0n0uVdbs11zK84Su0~B4ovEeUYMBtJl{j&&B@8H"
    "&(r5T=Q&@u`MJ+=a50W!&YNlJ?-7#z5krpSdCd4C&N}Ju=v<-yDVO)SC79RES*fp?q~mz+F)a8Dqw?jUWtmlC3tX=dTBWT-zuWxEYB<hk@>`p^"
    "E&cbzl=HsyON>6l$&vn<u3eJ<&{1JbzPFpG)VCCWs*&XrscXy$euGbcqVqZP#&lJfahnf(iXK<yoYWuG$FkKB&g{D7q!+kWVzSi?)Up5jwvnk#"
    "yZXM*pw4th`c<a3aDL_EN8G5AxL_i`G3GWKR-?mmL}^Cq1D$J~xb#mME#Pc2wnX<9;Y+5cZnwb=BN(n&y!XD&w1GJDED<kY@=UBUP$b@Addm#C"
    "%`<*MUo{D-J~JtGL3g!`%;;HWO4hi-RECj#lI<o|Qtd9C=@kD^XIiwrJsDEl_}7>ge394{6Wb-?HhZkbJIcAH-k&fcoL}sJdBn#yH?u@DB=Q8>"
    "Or%agFz>35>oyPXA`#75zI#@PZquD3nkBJG-+6PPMz7oa&}#H4r&lw4tQuJcR3p4??F;jEgTN7I_URK$x3O*p&FNiOe8DPtWMgHb1wvb-4j4M7"
    "Rc3OVUs{a;)fm(~R+N)NuE0}bcpu+3<D1MLkT}Bo!fu9;-c^szv|*8gPYb?Cs=>u7b0ub9GXF0vub6h5-&&2Zu}KD1<CIfCdQYB@>U8cgUnN!N"
    "u4Hp!tKh>@qv~VLCTDguzfER-<Wh}vjp;*@=ghf7tC92nKi8P%vB89Jih3vFqsj+GBEmT${)TC7*qsnljWP9+)pwUye3{|r#CMsjF!h3<Jk=v&"
    "Zu4)yqJ?8dlvAKree?^bO5m924xv5#2L#R<@9zW!Gp@T$>RsjN7JS8KerJc^3Gyc5W!^lL7f#C`_I5AdRJ7gIE%lMNX`33szwk+bFNrjW))_q^"
    ";4v-7dRICVDb*<G?bZlo@IND1##d+J2|a%@<TauZ{`!lPZ{EB5AEjOoX8"
))  # fmt: skip
"""A packet of a VLP-16, as the project einride/vlp16-go publishes it (`exampleData` of its packet tests)."""
FARTHEST_M = 2.2
"""All of its returns are nearer, and what `_box` simulates is farther away."""


def test_a_published_packet_is_decoded_as_an_independent_decoder_does(tmp_path: Path) -> None:
    """Real returns, with firings that met nothing: the packet within a revolution of simulated ones."""
    vd = pytest.importorskip("velodyne_decoder", reason="velodyne-decoder is not installed")
    blocks = np.frombuffer(PUBLISHED, BLOCK, BLOCKS)
    assert blocks["azimuth"][[0, -1]].tolist() == [0x2866, 0x2A1D]
    assert blocks["returns"]["distance"][0, :4].tolist() == [0, 0x2FF, 0, 0x310], "as they are listed there, too"
    assert blocks["returns"]["reflectivity"][-1, -4:].tolist() == [0x2E, 0x38, 5, 0x3A]
    place, packet_deg = 120, 12 * 2 * MODELS[VLP_16].firing_us * 3600e-6
    begin_deg = (blocks["azimuth"][0] / 100 - place * packet_deg) % 360
    packets = velodyne_packets(VLP_16, _box, begin_deg=begin_deg, turns=2.5)
    packets[place] = PUBLISHED
    scan = read_scan(write_packets(tmp_path / "published.pcap", packets))
    stamped = [vd.VelodynePacket(k * 1e-3, each) for k, each in enumerate(packets)]
    theirs = vd.ScanDecoder(vd.Config()).decode(stamped, True)[1]
    places = np.stack([theirs[axis] for axis in "xyz"], -1)
    published = np.linalg.norm(places, axis=-1) < FARTHEST_M
    compared = 0
    for row, ring in enumerate(range(15, -1, -1)):
        of_ring = published & (theirs["ring"] == ring)
        ours = np.linalg.norm(scan.points[row], axis=-1) < FARTHEST_M
        assert np.array_equal(scan.intensity[row][ours], theirs["intensity"][of_ring])
        assert places[of_ring] == pytest.approx(scan.points[row][ours], abs=5e-4), "azimuths there are to .01 deg"
        compared += int(ours.sum())
    assert compared == int((blocks["returns"]["distance"] > 0).sum())
    assert compared > 250


def test_lost_packets_leave_empty_cells(tmp_path: Path) -> None:
    whole = _recorded(tmp_path / "a.pcap", VLP_16, turns=1.5)
    packets = velodyne_packets(VLP_16, _box, turns=1.5)
    del packets[30:40]
    scan = read_scan(write_packets(tmp_path / "b.pcap", packets))
    assert scan.shape == whole.shape
    assert "240 firings are missing" in scan.notes[0]
    assert (whole.valid & ~scan.valid).sum() == whole.valid[:, ~scan.valid.any(axis=0)].sum() > 3000
    assert np.abs(scan.rays - whole.rays).max() < 0.01
    del packets[20:60]
    with pytest.raises(FormatError, match="are missing from the revolution"):
        read_scan(write_packets(tmp_path / "c.pcap", packets))


def test_revolutions_are_counted(tmp_path: Path) -> None:
    packets = velodyne_packets(VLP_16, _box, turns=3.3, begin_deg=10.0)
    path = write_packets(tmp_path / "a.pcap", packets)
    assert [read_scan(path, scan_index=k).shape[0] for k in (0, 1)] == [16, 16]
    with pytest.raises(OptionError, match="2 whole ones"):
        read_scan(path, scan_index=2)
    with pytest.raises(FormatError, match=r"no whole revolution.*half a second"):
        read_scan(write_packets(tmp_path / "b.pcap", packets[:60]))


def test_other_models_are_refused_by_name(tmp_path: Path) -> None:
    packets = velodyne_packets(VLP_16, _box, turns=2.1)
    for product, name in ((0x28, "VLP-32C"), (0x63, "VLS-128"), (0x00, "0x00")):
        changed = [each[:PRODUCT_AT] + bytes([product]) for each in packets]
        with pytest.raises(FormatError, match=f"{name}.*not read.*VeloView"):
            read_scan(write_packets(tmp_path / "a.pcap", changed))
    changed = [each[:MODE_AT] + bytes([0x11, VLP_16]) for each in packets]
    with pytest.raises(FormatError, match="return mode 0x11"):
        read_scan(write_packets(tmp_path / "a.pcap", changed))
    still = [packets[0]] * 200
    with pytest.raises(FormatError, match="no whole revolution"):
        read_scan(write_packets(tmp_path / "a.pcap", still))
