"""What the trials of a self-test say, in figures and in a sentence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.progress import Report
from ladarreg_core.scan import Scan
from ladarreg_core.self_test.trials import START_LEVELS_DEG, SelfTestOptions, Trial, run_trials

_MOST_MISSES = 0.34  # of a level's starts may fail and it still 'works'


@dataclass(frozen=True, slots=True)
class SelfTest:
    """What to expect of a scan and a camera."""

    trials: tuple[Trial, ...]
    """All that was tried."""

    def of(self, kind: str) -> tuple[Trial, ...]:
        """Return the trials of a kind."""
        return tuple(trial for trial in self.trials if trial.kind == kind)

    @property
    def accepted_wrongly(self) -> int:
        """How many were called registered and were not: pictures of other places, and poses beyond 3 px."""
        return sum(t.accepted and not t.right for t in (*self.of("right"), *self.of("wrong")))

    @property
    def position_mm(self) -> float:
        """Median error of the camera's place where it was found, mm; NaN: never found."""
        return _median([t.error_mm for t in self.of("right") if t.right])

    @property
    def angle_deg(self) -> float:
        """Median error of its direction where it was found, deg; NaN: never found."""
        return _median([t.error_deg for t in self.of("right") if t.right])

    @property
    def picture_px(self) -> float:
        """Median error of the picture where it was found, px; NaN: never found."""
        return _median([t.error_px for t in self.of("right") if t.right])

    @property
    def start_deg(self) -> float:
        """The farthest level of starts that nearly all came home, as all nearer ones did; 0: none; NaN: not tried."""
        starts = self.of("start")
        if not starts:
            return float("nan")
        reached = 0.0
        for level in START_LEVELS_DEG:
            there = [t for t in starts if t.off_deg == level]
            if there and np.mean([not t.right for t in there]) > _MOST_MISSES:
                break
            reached = level if there else reached
        return reached

    def in_words(self) -> str:
        """Return the expectation as a sentence."""
        parts = []
        right = self.of("right")
        found = sum(t.right for t in right)
        if right and found:
            parts.append(f"{_length(self.position_mm)}, {self.angle_deg:.2g} deg, {found} of {len(right)}")
        elif right:
            parts.append(f"none of {len(right)} photographs could be registered")
        if not np.isnan(self.start_deg):
            works = f"starts up to {self.start_deg:.0f} deg work" if self.start_deg else "starts 3 deg off fail"
            parts.append(works)
        wrong = self.of("wrong")
        if wrong:
            parts.append(f"{sum(t.right for t in wrong)} of {len(wrong)} wrong places refused")
        return f"With this scan and camera: {'; '.join(parts)}."

    def advice(self) -> str:
        """Return what to do, empty where all is well."""
        right = self.of("right")
        if self.accepted_wrongly:
            return "Do not rely on 'accepted' alone here: check every registration by eye, and add drawn lines."
        if right and sum(t.right for t in right) < 0.75 * len(right):
            return "Automatic registration will often fail here: have lines drawn by hand, or give a rough pose."
        return ""


def self_test(
    scan: Scan, camera: Camera, options: SelfTestOptions | None = None, *, report: Report | None = None
) -> SelfTest:
    """Try a scan and a camera on photographs made from the scan itself.

    What it tells is what to expect of photographs of the very scene, taken when nothing had moved: an upper bound.

    Args:
        scan: the scan.
        camera: the camera of the photographs to come.
        options: how much is tried, and for how long.
        report: told before each trial; may raise `Cancelled`.

    Raises:
        DegenerateGeometryError: if no camera beside the scanner sees enough of the scan.
    """
    return SelfTest(tuple(run_trials(scan, camera, options, report=report)))


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if values else float("nan")


def _length(mm: float) -> str:
    return f"{mm:.2g} mm" if mm < 99.5 else f"{mm / 1000:.2g} m"
