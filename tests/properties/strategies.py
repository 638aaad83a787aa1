"""Random rotations, poses and directions for the laws; rotations near zero and near pi come often."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from ladarreg_core.frames import Rigid

_component = st.floats(-1, 1, allow_nan=False, width=64)
_angle = st.one_of(
    st.floats(0, np.pi),
    st.sampled_from([0.0, 1e-12, 1e-9, 1e-7, 1e-5, 1e-4, np.pi - 1e-4, np.pi - 1e-7, np.pi - 1e-10, np.pi]),
)


@st.composite
def unit_vectors(draw: st.DrawFn) -> np.ndarray:
    """A unit vector (3,), the axes among them."""
    v = draw(hnp.arrays(np.float64, 3, elements=_component))
    length = np.linalg.norm(v)
    return v / length if length > 1e-3 else np.array([0.0, 0.0, 1.0])


@st.composite
def rotvecs(draw: st.DrawFn) -> np.ndarray:
    """A rotation vector (3,) of length 0 to pi."""
    return draw(unit_vectors()) * draw(_angle)


@st.composite
def poses(draw: st.DrawFn, *, reach_m: float = 20.0) -> Rigid:
    """A rigid transform."""
    return Rigid.from_rotvec(
        draw(rotvecs()), draw(hnp.arrays(np.float64, 3, elements=st.floats(-reach_m, reach_m, allow_nan=False)))
    )


def points(count: int = 5, *, reach_m: float = 50.0) -> st.SearchStrategy[np.ndarray]:
    """Points (count, 3)."""
    return hnp.arrays(np.float64, (count, 3), elements=st.floats(-reach_m, reach_m, allow_nan=False))
