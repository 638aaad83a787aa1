"""A candidate that keeps no window has a verdict with a reason."""

from __future__ import annotations

import numpy as np

from ladarreg_core.matching.verify.agreement import Agreement
from ladarreg_core.matching.verify.verification import verify


def test_a_candidate_without_windows_is_refused_with_a_reason() -> None:
    none = np.zeros(0, np.intp)
    maps = Agreement(
        1, 4, np.zeros((0, 9, 9)), np.zeros((0, 2), np.intp), none, (), np.zeros((0, 2)), np.zeros(0, np.bool_)
    )
    shift, height, border = maps.peaks()
    assert (shift.shape, height.shape, border.shape) == ((0, 2), (0,), (0,))
    found = verify(maps, maps)
    assert not found.accepted
    assert found.reasons[0].startswith("Only 0 image regions")
