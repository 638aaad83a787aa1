"""Packets that a Velodyne sensor sends, for whatever it measures."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ladarreg_core.formats.packets.velodyne_packet import (
    BLOCK,
    BLOCKS,
    DISTANCE_M,
    DUAL,
    FLAG,
    MODELS,
    RETURNS,
    TURN,
)
from ladarreg_core.foundations.arrays import FloatArray, IntArray

Measure = Callable[[IntArray, FloatArray], tuple[FloatArray, FloatArray]]
"""Of lasers and azimuths, rad: ranges, m, 0 for none, and reflectivities, 0-255, each in the same shape."""
STRONGEST = 0x37
_LARGEST = 0xFFFF


def velodyne_packets(
    product: int,
    measure: Measure,
    *,
    mode: int = STRONGEST,
    rate_hz: float = 10.0,
    begin_deg: float = 170.0,
    turns: float = 1.1,
    strongest: float = 1.0,
) -> list[bytes]:
    """Return the data packets of so many turns.

    Args:
        product: number of the model, a key of `MODELS`.
        measure: what the lasers measure.
        mode: return mode; in the dual one the strongest return is at a share of the last one's range.
        rate_hz: turns a second.
        begin_deg: azimuth of the first block, clockwise from above.
        turns: how many.
        strongest: that share.
    """
    model = MODELS[product]
    block_us = model.firings * model.firing_us
    pairs = 2 if mode == DUAL else 1
    blocks_each = BLOCKS // pairs
    packets = int(turns / rate_hz * 1e6 / (block_us * blocks_each))
    starts_us = np.arange(packets * blocks_each) * block_us
    when_us = starts_us[:, None] + model.delays_us.ravel()
    azimuth = np.radians((begin_deg + 360e-6 * rate_hz * when_us) % 360.0)
    lasers = np.broadcast_to(np.arange(RETURNS) % len(model.elevations_deg), azimuth.shape)
    ranges, reflectivity = measure(lasers, azimuth)
    blocks = np.zeros((len(starts_us), pairs), BLOCK)
    blocks["flag"] = FLAG
    blocks["azimuth"] = (np.rint(np.degrees(azimuth[:, :1]) * 100).astype(np.int64)) % TURN
    for k, share in enumerate((1.0, strongest)[:pairs]):
        distance = np.rint(ranges * share / DISTANCE_M)
        blocks["returns"]["distance"][:, k] = np.where(distance <= _LARGEST, distance, 0)
        blocks["returns"]["reflectivity"][:, k] = np.clip(np.rint(reflectivity), 0, 255)
    ends = [round(first).to_bytes(4, "little") + bytes([mode, product]) for first in starts_us[::blocks_each].tolist()]
    return [part.tobytes() + end for part, end in zip(blocks.reshape(packets, BLOCKS), ends, strict=True)]
