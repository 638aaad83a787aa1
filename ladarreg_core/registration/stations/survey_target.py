"""`SurveyTarget`: a target that was found in a scan."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import OptionError
from ladarreg_core.foundations.validation import require_int
from ladarreg_core.scan import Scan


@dataclass(frozen=True, slots=True, eq=False)
class SurveyTarget:
    """A survey target that was found in a scan: a sphere, or a flat one of four quadrants."""

    center: NDArray[np.float64]
    """(3,) float64 in the scanner's frame, m."""
    covariance: NDArray[np.float64]
    """(3, 3) float64 of the center, m^2."""
    radius_m: float | None
    """Radius of the sphere, as given; None for a flat one."""
    rms_m: float
    """RMS of the residuals, m: of a sphere along the rays, of a flat one across it."""
    cells: int
    """Cells that the fit rests on."""
    left_out: int
    """Cells on the sphere's face that do not fit it, such as those of something in front of it; of a flat one, cells
    beside it that lie on its plane."""
    side_m: float | None = None
    """Side of a flat one, as given."""

    @property
    def sigma_m(self) -> float:
        """Largest standard deviation of the center, m."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance)[-1]))


def picked_cell(scan: Scan, pick: tuple[int, int]) -> tuple[int, int]:
    """Return row and column of a pick; raise `OptionError` unless it is a cell of the scan."""
    if not isinstance(pick, tuple | list) or len(pick) != 2:
        raise OptionError(f"the pick is {pick!r}; give the row and the column of a cell on the target", field="pick")
    for value, name, size in zip(pick, ("the row", "the column"), scan.shape, strict=True):
        require_int(value, f"{name} of the pick", least=0, most=size - 1)
    return int(pick[0]), int(pick[1])
