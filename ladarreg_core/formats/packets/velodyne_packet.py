"""Data packets of Velodyne sensors: how they are laid out, how the lasers stand, and when they fire.

Source: Velodyne, VLP-16 User Manual 63-9243 Rev. D, chapter 9; HDL-32E User's Manual, firing order and appendices B, E.
Where the lasers of the HDL-32E cross is as velodyne_decoder 3.1 states it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ladarreg_core.foundations.arrays import FloatArray

BLOCKS, RETURNS = 12, 32
"""Blocks of a packet, and returns of a block."""
BLOCK = np.dtype(
    [("flag", "<u2"), ("azimuth", "<u2"), ("returns", [("distance", "<u2"), ("reflectivity", "u1")], RETURNS)]
)
"""A block: azimuth in hundredths of a degree, distances in units of `DISTANCE_M`, 0 = no return."""
PACKET_BYTES = 1206
"""Bytes of a data packet: the blocks, a time of 4 bytes, and the two that follow."""
MODE_AT, PRODUCT_AT = 1204, 1205
"""Where return mode and model stand."""
FLAG = 0xEEFF
"""What a block begins with."""
RETURN_MODES = {0x37: "the strongest return", 0x38: "the last return", 0x39: "the last of two returns"}
DUAL = 0x39
"""Return mode in which two blocks follow one another for the same firings, the last returns first."""
TURN = 36_000
"""A turn in the unit of the azimuths."""
DISTANCE_M = 0.002


@dataclass(frozen=True, slots=True)
class Model:
    """How the lasers of a model stand, and when they fire."""

    name: str
    elevations_deg: tuple[float, ...]
    """Of each laser, in the order of the packet."""
    crossing_mm: float
    """How far from the axis all lasers cross, at the height of the sensor's origin; ranges count from the axis."""
    firing_us: float
    """From one firing of all lasers to the next."""
    laser_us: float
    """From one laser to the next."""

    @property
    def heights_m(self) -> FloatArray:
        """(L,) what is to be added to the height of each laser's points: its beam meets the axis there."""
        return -self.crossing_mm / 1000 * np.tan(np.radians(self.elevations_deg))

    @property
    def firings(self) -> int:
        """Firings of all lasers that a block holds."""
        return RETURNS // len(self.elevations_deg)

    @property
    def delays_us(self) -> FloatArray:
        """(firings, L) time of each return of a block after its first."""
        return (np.arange(self.firings) * self.firing_us)[:, None] + np.arange(len(self.elevations_deg)) * self.laser_us


_PUCK_DEG = (-15.0, 1.0, -13.0, 3.0, -11.0, 5.0, -9.0, 7.0, -7.0, 9.0, -5.0, 11.0, -3.0, 13.0, -1.0, 15.0)
_HI_RES_DEG = (
    -10.0, 0.667, -8.667, 2.0, -7.333, 3.333, -6.0, 4.667, -4.667, 6.0, -3.333, 7.333, -2.0, 8.667, -0.667, 10.0,
)  # fmt: skip
_HDL_32_DEG = (
    -30.67, -9.33, -29.33, -8.0, -28.0, -6.67, -26.67, -5.33, -25.33, -4.0, -24.0, -2.67, -22.67, -1.33, -21.33, 0.0,
    -20.0, 1.33, -18.67, 2.67, -17.33, 4.0, -16.0, 5.33, -14.67, 6.67, -13.33, 8.0, -12.0, 9.33, -10.67, 10.67,
)  # fmt: skip
VLP_16, HI_RES, HDL_32 = 0x22, 0x24, 0x21
MODELS: Mapping[int, Model] = {
    HDL_32: Model("HDL-32E", _HDL_32_DEG, 28.95, 46.08, 1.152),
    VLP_16: Model("VLP-16 or Puck LITE", _PUCK_DEG, 41.91, 55.296, 2.304),
    HI_RES: Model("Puck Hi-Res", _HI_RES_DEG, 41.91, 55.296, 2.304),
}
"""By the number in the packet."""
