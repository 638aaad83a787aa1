"""Reader of Velodyne lidar recordings: data packets of the VLP-16, Puck LITE, Puck Hi-Res and HDL-32E in a pcap file.

Source: as `velodyne_packet`.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import FormatError, OptionError
from ladarreg_core.formats.packets.capture import Datagram, datagrams
from ladarreg_core.formats.packets.velodyne_packet import (
    BLOCK,
    BLOCKS,
    DISTANCE_M,
    DUAL,
    FLAG,
    MODE_AT,
    MODELS,
    PACKET_BYTES,
    PRODUCT_AT,
    RETURN_MODES,
    TURN,
    Model,
)
from ladarreg_core.formats.parsing.budget import ReadBudget
from ladarreg_core.formats.parsing.untrusted import PathLike, as_float32, reading
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grid_order import order_of
from ladarreg_core.scanner.grids import TabulatedGrid

_SEAM = 18_000  # behind the sensor, so that what it looks at is not cut
_LOST_STEPS = 1.5  # steps of azimuth from one firing to the next, beyond which one is missing
_MAX_COLUMNS = 10_000  # a revolution at 2 a second; the sensors make 5 to 20
_MAX_MISSING = 0.5
_LOOKED_AT = 400  # datagrams, by which a recording is known
_CELL_BYTES = 400
_OTHERS = {0x28: "VLP-32C", 0x31: "Velarray", 0x63: "VLS-128", 0xA1: "VLS-128"}


def is_velodyne(path: Path) -> bool:
    """Return whether data packets of a Velodyne sensor are among the first of a recording.

    Raises:
        FormatError: if the recording is damaged.
    """
    with open(path, "rb") as stream:
        for count, datagram in enumerate(datagrams(stream)):
            if _is_data(datagram):
                return True
            if count >= _LOOKED_AT:
                break
    return False


def read_velodyne_pcap(
    path: PathLike, *, scan_index: int = 0, memory_bytes: int | None = None, report: Report | None = None
) -> Scan:
    """Read one revolution of a Velodyne recording as a scan.

    Args:
        path: the recording.
        scan_index: index among the whole revolutions, from 0.
        memory_bytes: memory that the read may use, bytes; None: see `budget`.
        report: receives the progress, in bytes.

    Returns:
        The scan. Its origin is the sensor's; X points to azimuth 0, where the sensor's Y axis points, Y to its left, Z
        up. Each cell has the azimuth of the moment at which its laser fired. The intensity is the calibrated
        reflectivity, 0-255; of two returns the last one is taken.

    Raises:
        FormatError: if the recording is damaged, the model is not read, or no revolution is whole.
        ShapeError: if there are no returns.
        OptionError: if there is no revolution of that index.
    """
    with reading(path) as file:
        budget = ReadBudget.of(file.stat().st_size, memory_bytes)
        if isinstance(scan_index, bool) or not isinstance(scan_index, int) or scan_index < 0:
            raise OptionError(f"there is no revolution {scan_index!r}; revolutions are counted from 0")
        model, mode, payloads = _revolution(file, scan_index, report)
        azimuth, returns = _firings(model, mode, payloads)
        azimuth, returns, missing = _cut(azimuth, returns)
        budget.require_cells(len(model.elevations_deg), len(azimuth), _CELL_BYTES)
        return _to_scan(file.stem, model, mode, azimuth, returns, missing)


def _is_data(datagram: Datagram) -> bool:
    return len(datagram.payload) == PACKET_BYTES and datagram.payload[:2] == FLAG.to_bytes(2, "little")


def _data_packets(file: Path, report: Report | None) -> Iterator[bytes]:
    """Yield the data packets of the first sensor in a recording."""
    total = file.stat().st_size
    first: tuple[bytes, int] | None = None
    with open(file, "rb") as stream:
        for count, datagram in enumerate(datagrams(stream)):
            if report is not None and count % 64 == 0:
                report(Progress(stream.tell(), total, "reading the packets"))
            if not _is_data(datagram):
                continue
            first = first or (datagram.source, datagram.port)
            if (datagram.source, datagram.port) == first:
                yield datagram.payload


def _revolution(file: Path, index: int, report: Report | None) -> tuple[Model, int, list[bytes]]:
    """Return model, return mode and the packets that hold the whole revolution of an index.

    The packets in which it begins and ends are included, so that both seams lie within.
    """
    seams = 0
    packets: list[bytes] = []
    for payload in _data_packets(file, report):
        if not packets:
            _require_known(payload[MODE_AT], payload[PRODUCT_AT])
        elif payload[MODE_AT:] != packets[-1][MODE_AT:]:
            raise FormatError("the sensor was set to another return mode within the recording; record again")
        seams += _seams(packets[-1:], payload)
        if seams <= index:
            packets.clear()  # of what comes before, the last packet is needed: the seam may follow it at once
        packets.append(payload)
        if seams > index + 1:
            return MODELS[payload[PRODUCT_AT]], payload[MODE_AT], packets
    whole = max(seams - 1, 0)
    if whole == 0:
        raise FormatError("it contains no whole revolution of the sensor; record for at least half a second")
    raise OptionError(f"there is no revolution {index}; the recording contains {whole} whole ones, from 0")


def _seams(before: list[bytes], payload: bytes) -> int:
    """Return how often the seam is passed from the end of the packet before, if there is one, to that of a packet."""
    azimuths = np.concatenate([*(_blocks(packet)["azimuth"][-1:] for packet in before), _blocks(payload)["azimuth"]])
    phases = (azimuths.astype(np.int64) - _SEAM) % TURN
    return int(np.count_nonzero(np.diff(phases) < -TURN // 2))


def _require_known(mode: int, product: int) -> None:
    if product not in MODELS:
        name = _OTHERS.get(product, f"a model of the number 0x{product:02x}")
        known = ", ".join(model.name for model in MODELS.values())
        raise FormatError(
            f"its packets are those of a Velodyne {name}, which is not read (read are {known}); save the frame as PCD "
            "with VeloView"
        )
    if mode not in RETURN_MODES:
        raise FormatError(f"its packets state the return mode 0x{mode:02x}, which is not known; the file is damaged")


def _blocks(payload: bytes) -> NDArray[np.void]:
    return np.frombuffer(payload, BLOCK, BLOCKS)


def _firings(model: Model, mode: int, payloads: list[bytes]) -> tuple[FloatArray, NDArray[np.void]]:
    """Return the azimuth of each laser at each firing (N, L), in unwrapped hundredths of a degree, and returns (N, L).

    The azimuth of a block is that of its first laser; between two blocks the sensor turns evenly.
    """
    blocks = np.concatenate([_blocks(payload) for payload in payloads])
    if mode == DUAL:  # two blocks for the same firings, the last returns first
        blocks = blocks[::2]
    blocks = blocks[blocks["flag"] == FLAG]
    starts = np.unwrap(blocks["azimuth"].astype(np.float64), period=TURN)
    gaps = np.diff(starts, append=np.nan)
    usual = float(np.nanmedian(gaps)) if len(gaps) > 1 else 0.0
    if usual <= 0:
        raise FormatError("the sensor does not turn clockwise in it, or not at all; record while it spins")
    gaps = np.where((gaps > 0) & (gaps < _LOST_STEPS * usual), gaps, usual)
    azimuth = starts[:, None, None] + gaps[:, None, None] * model.delays_us / (model.firings * model.firing_us)
    lasers = len(model.elevations_deg)
    return azimuth.reshape(-1, lasers), blocks["returns"].reshape(-1, lasers)


def _cut(azimuth: FloatArray, returns: NDArray[np.void]) -> tuple[FloatArray, NDArray[np.void], int]:
    """Return the firings between the first two seams, with empty ones where packets were lost, and their number."""
    turn = np.floor((azimuth[:, 0] - _SEAM) / TURN)
    inside = turn == turn[0] + 1
    azimuth, returns = azimuth[inside], returns[inside]
    if len(azimuth) > _MAX_COLUMNS:
        raise FormatError(f"a revolution of its sensor has {len(azimuth):,} firings; sensors at 5 to 20 Hz are read")
    steps = np.diff(azimuth[:, 0])
    step = float(np.mean(steps[steps < _LOST_STEPS * np.median(steps)])) if len(steps) else TURN
    begin = (turn[0] + 1) * TURN + _SEAM
    lost = np.where(steps > _LOST_STEPS * step, np.rint(steps / step) - 1, 0).astype(np.int64)
    at_ends = (azimuth[0, 0] - begin) // step + max(0, (begin + TURN - azimuth[-1, 0]) // step - 1)
    missing = int(lost.sum() + at_ends)
    if missing > _MAX_MISSING * (TURN / step):
        raise FormatError(
            f"{missing:,} of {TURN / step:,.0f} firings are missing from the revolution; record it again, or take "
            "another one"
        )
    if lost.any():
        for at in np.flatnonzero(lost)[::-1]:
            shares = np.arange(1, lost[at] + 1)[:, None] / (lost[at] + 1)
            between = azimuth[at] + shares * (azimuth[at + 1] - azimuth[at])
            azimuth = np.insert(azimuth, at + 1, between, axis=0)
            returns = np.insert(returns, np.full(lost[at], at + 1), np.zeros(1, returns.dtype), axis=0)
    return azimuth, returns, missing


def _to_scan(name: str, model: Model, mode: int, azimuth: FloatArray, returns: NDArray[np.void], missing: int) -> Scan:
    """Return the scan of firings (N, L), with a row for each laser.

    Source: VLP-16 User Manual, figure 9-1 and table 9-1; its Y is the scan's X, its X the scan's -Y.
    """
    elevation = np.radians(model.elevations_deg)[:, None]
    alpha = np.radians(azimuth.T / 100.0)
    beams = np.stack(
        [np.cos(elevation) * np.cos(alpha), -np.cos(elevation) * np.sin(alpha),
         np.broadcast_to(np.sin(elevation), alpha.shape)], axis=-1,
    )  # fmt: skip
    distance = returns["distance"].T * DISTANCE_M
    points = distance[..., None] * beams
    points[..., 2] += model.heights_m[:, None]
    has = distance > 0
    length = np.linalg.norm(points, axis=-1)
    rays = np.where(has[..., None], points / np.where(has, length, 1.0)[..., None], beams)
    top_first = np.argsort(model.elevations_deg)[::-1]
    order = order_of(beams[top_first])
    lost = f"; {missing:,} firings are missing" if missing else ""
    return Scan(
        TabulatedGrid(order.apply(rays[top_first])),
        as_float32(order.apply(np.where(has, length, np.nan)[top_first])),
        as_float32(order.apply(returns["reflectivity"].T[top_first])),
        intensity_is="range_normalised",
        name=name,
        notes=(f"a revolution of a Velodyne {model.name}, {RETURN_MODES[mode]}{lost}",),
    )
