"""The range-spike gate and the filling of holes."""

from __future__ import annotations

import numpy as np

from ladarreg_core.surface.spikes import fill_from_nearest, gate_spikes


def test_spikes_go_and_surfaces_stay() -> None:
    rng = np.random.default_rng(3)
    ranges = np.full((60, 80), 4.0)
    ranges[:, 40:] = 2.5  # a step edge is no spike
    ranges *= 1 + rng.normal(0, 0.003, ranges.shape)
    spikes = np.zeros(ranges.shape, bool)
    spikes[rng.integers(3, 57, 40), rng.integers(3, 77, 40)] = True
    ranges[spikes] *= 1.3
    ranges[10:14, 10:14] = np.nan
    gated = gate_spikes(ranges)
    assert np.isnan(gated[spikes]).all()
    others = ~spikes & np.isfinite(ranges)
    assert np.isfinite(gated[others]).mean() > 0.995


def test_filling_takes_the_nearest_value_and_nothing_else() -> None:
    image = np.zeros((5, 9), np.float32)
    image[:, 0], image[:, 8] = 1, 2
    valid = image > 0
    filled = fill_from_nearest(image, valid)
    assert (filled[:, :4] == 1).all()
    assert (filled[:, 5:] == 2).all()
    assert (fill_from_nearest(image, np.zeros_like(valid)) == 0).all()
