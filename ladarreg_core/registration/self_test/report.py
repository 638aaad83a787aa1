"""Report of a self-test: the results of its trials in figures and in a sentence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.foundations.formatting import format_length
from ladarreg_core.foundations.progress import Report
from ladarreg_core.registration.self_test.trials import START_LEVELS_DEG, SelfTestOptions, Trial, run_trials
from ladarreg_core.scan import Scan

_MAX_MISSES = 0.34  # share of the starts of a level that may fail while the level still counts as working


@dataclass(frozen=True, slots=True)
class SelfTest:
    """Expected accuracy of a scan and a camera."""

    trials: tuple[Trial, ...]
    """All trials."""

    def of(self, kind: str) -> tuple[Trial, ...]:
        """Return the trials of a kind."""
        return tuple(trial for trial in self.trials if trial.kind == kind)

    @property
    def accepted_wrongly(self) -> int:
        """Number of false acceptances: unrelated photos, and poses off by more than 3 px, or three cells if coarse."""
        return sum(t.accepted and not t.right for t in (*self.of("right"), *self.of("wrong")))

    @property
    def position_mm(self) -> float:
        """Median error of the camera position over successful trials, mm; NaN: none."""
        return _median([t.error_mm for t in self.of("right") if t.right])

    @property
    def angle_deg(self) -> float:
        """Median error of the camera orientation over successful trials, deg; NaN: none."""
        return _median([t.error_deg for t in self.of("right") if t.right])

    @property
    def picture_px(self) -> float:
        """Median error of photo positions over successful trials, px; NaN: none."""
        return _median([t.error_px for t in self.of("right") if t.right])

    @property
    def start_deg(self) -> float:
        """Largest start error from which, as from all smaller ones, nearly all trials succeed; 0: none; NaN: not
        tried."""
        starts = self.of("start")
        if not starts:
            return float("nan")
        reached = 0.0
        for level in START_LEVELS_DEG:
            at_level = [t for t in starts if t.off_deg == level]
            if at_level and np.mean([not t.right for t in at_level]) > _MAX_MISSES:
                break
            reached = level if at_level else reached
        return reached

    def summary(self) -> str:
        """Return the expected accuracy as a sentence."""
        parts = []
        right = self.of("right")
        found = sum(t.right for t in right)
        if right and found:
            parts.append(
                f"{format_length(self.position_mm / 1000)}, {self.angle_deg:.2g} deg, "
                f"{found} of {len(right)} photos registered"
            )
        elif right:
            parts.append(f"none of {len(right)} photos registered")
        if not np.isnan(self.start_deg):
            works = f"starts up to {self.start_deg:.0f} deg off work" if self.start_deg else "starts 3 deg off fail"
            parts.append(works)
        wrong = self.of("wrong")
        if wrong:
            parts.append(f"{sum(t.right for t in wrong)} of {len(wrong)} unrelated photos refused")
        return f"With this scan and camera: {'; '.join(parts)}."

    def counts(self) -> str:
        """Return how many photographs of each kind are correct and accepted, in one line."""
        kinds = dict.fromkeys(trial.kind for trial in self.trials)
        of_kind = {kind: [trial for trial in self.trials if trial.kind == kind] for kind in kinds}
        return "; ".join(
            f"{kind}: {sum(t.right for t in of)} of {len(of)} correct, {sum(t.accepted for t in of)} accepted"
            for kind, of in of_kind.items()
        )

    def advice(self) -> str:
        """Return advice for this scan and camera; empty where none is needed."""
        right = self.of("right")
        if self.accepted_wrongly:
            return "Do not rely on 'accepted' alone here: check every registration by eye, and add drawn lines."
        if right and sum(t.right for t in right) < 0.75 * len(right):
            return "Automatic registration will often fail here: draw lines by hand, or give a rough initial pose."
        return ""


def self_test(
    scan: Scan, camera: Camera, options: SelfTestOptions | None = None, *, report: Report | None = None
) -> SelfTest:
    """Estimate, before fieldwork, how well a scan and a camera will register, on synthetic photographs of the scan.

    These show exactly the scanned scene with nothing moved, so that the result is an upper bound.

    Args:
        scan: the scan.
        camera: the camera that will take the photographs.
        options: number of trials, and time limit.
        report: called before each trial; may raise `Cancelled`.

    Raises:
        DegenerateGeometryError: if no camera beside the scanner sees enough of the scan.
    """
    return SelfTest(tuple(run_trials(scan, camera, options, report=report)))


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if values else float("nan")
