"""A registered scan with layers: quantities of its cells, and pictures of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from numpy.typing import NDArray

from ladarreg_core.export.registered_scan import RegisteredScan
from ladarreg_core.foundations.arrays import ByteArray


@dataclass(frozen=True, slots=True, eq=False)
class LayerValues:
    """A quantity of the cells."""

    values: NDArray[Any]
    """(H, W) uint8, uint16 or float32."""
    meaning: str
    """What it is, with its unit; the first 32 bytes stand in a LAS file."""


@dataclass(frozen=True, slots=True, eq=False)
class LayerPicture:
    """A picture of the cells."""

    draw: Callable[[], ByteArray]
    """Returns it, (H, W, 3) uint8 RGB."""
    is_map: bool
    """Its colours stand for values, so that they must not change."""


@dataclass(frozen=True, slots=True, eq=False)
class LayeredScan:
    """A part of a model: a scan with its photographs and layers. All parts of a model have the same layers."""

    handed: RegisteredScan
    """The scan, its photographs and its colours."""
    values: Mapping[str, LayerValues] = field(default_factory=dict)
    """Quantities of the cells, by the names that they have in files of points."""
    pictures: Mapping[str, LayerPicture] = field(default_factory=dict)
    """Pictures of the grid, by the names of the variants of a model."""
