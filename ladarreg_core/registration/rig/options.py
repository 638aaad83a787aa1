"""Options of the registration of a rig."""

from __future__ import annotations

from dataclasses import dataclass

from ladarreg_core.foundations.validation import LARGEST_INT, require_int

MIN_PAIRS = 2
"""Least number of pairs of a rig, and of those that must agree."""
NEAR_PX, FINE_NEAR_PX = 3.0, 1.5
"""Largest distance of a region's correlation peak from zero shift to agree, working pixels at levels 1 and 0."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RigOptions:
    """Options of the registration of a rig; saved with its result."""

    seed: int = 0
    """Random seed; equal seeds give equal results."""
    estimate_time_offset: bool = False
    """Also estimate by how much the photographs are stamped later than the scans, and pair them accordingly; needs the
    photographs before and after each pair (`RigPair.taken`)."""
    candidates_per_pair: int = 4
    """Number of poses that each pair proposes."""
    refined: int = 5
    """Number of candidates that are refined on all pairs."""
    least_chance: float = 0.06
    """Least probability assumed for a block of a pair that was held out to agree by chance."""
    few: int = 12
    """With fewer agreeing regions, agreement by chance must be ruled out, else the pair is undecided."""
    false_alarm: float = 1e-6
    """Most probability of the held-out agreement by chance, without the pair that agrees best."""
    fine_fraction: float = 0.2
    """Least share of the regions of all agreeing pairs that agree at full resolution."""

    def __post_init__(self) -> None:
        require_int(self.seed, "the seed", least=0, most=LARGEST_INT)
