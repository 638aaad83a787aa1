"""The embedded sample with range spikes under matches whose truth is known, on its surfaces and beside its edges."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import ladarreg_core as lr
from ladarreg_core.foundations.arrays import BoolArray, FloatArray
from ladarreg_core.simulate.sample import sample_folder
from testing.scenes.true_matches import true_points


@dataclass(frozen=True, eq=False)
class SpikedScan:
    """A scan with spikes, and matches on and off them."""

    file: Path
    """Its file, `.npz`."""
    truth: FloatArray
    """(H, W) ranges without the spikes, m; NaN without a return."""
    spiked: BoolArray
    """(H, W) cells with a wrong range."""
    edges: BoolArray
    """(H, W) cells whose 5 x 5 neighbours, without the spikes, differ by more than 5 %."""
    matches: list[dict[str, Any]]
    """Points as fields of `add_pick`: a third of them on spikes, the first of these beside depth edges."""


def spiked_sample(file: Path, *, count: int = 60, beside_edges: int = 3, seed: int = 4) -> SpikedScan:
    """Write the sample's scan with spikes under a third of `count` matches, and under as many cells without one.

    Args:
        file: where to write it.
        count: number of matches.
        beside_edges: so many of the spikes lie within two cells of a depth edge; two cells beside each are spikes, too,
            so that what stands out there is no longer alone.
        seed: of everything.
    """
    folder = sample_folder()
    scan = lr.read_scan(folder / "scan.npz")
    matches = true_points(count, seed=seed, noise_px=0.2)
    rng = np.random.default_rng(seed)
    cells = np.rint(scan.geometry.cell_of(np.array([one["scan"][0] for one in matches]))).astype(int)
    edges = _edges(scan.ranges)
    calm = np.flatnonzero(~edges[tuple(cells.T)])
    hit = calm[: count // 3]
    spiked = np.zeros(scan.shape, bool)
    spiked[tuple(cells[hit].T)] = True
    crowded = cells[hit[:beside_edges]]
    for step in ((-2, 0), (0, -2), (0, 2)):  # others stand out beside them, as an edge does
        spiked[tuple((crowded + step).T)] = True
    free = np.argwhere(scan.valid & ~edges)
    spiked[tuple(free[rng.permutation(len(free))[: count // 3]].T)] = True
    factor = np.where(rng.random(scan.shape) < 0.5, 0.75, 1.3)
    stored = dict(np.load(folder / "scan.npz"))
    counts = np.rint((scan.ranges * factor - stored["r0_m"]) / stored["dr_m"])
    spiked &= (counts > 0) & (counts < np.iinfo(np.uint16).max)
    stored["counts"][spiked] = counts[spiked].astype(np.uint16)
    np.savez_compressed(file, **stored)
    return SpikedScan(file, scan.ranges, spiked, edges, matches)


def _edges(ranges: FloatArray) -> BoolArray:
    padded = np.pad(ranges, 2, constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (5, 5))
    with np.errstate(invalid="ignore"):
        return np.asarray((np.abs(windows - ranges[..., None, None]) > 0.05 * ranges[..., None, None]).any(axis=(2, 3)))
