"""Wrongly stated cameras: focal length and lens estimated with the pose, or kept."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.pose.report import Bar, Section, number, percent, table
from ladarreg_core.camera import Camera
from ladarreg_core.errors import LadarregError
from ladarreg_core.pose.estimate import PoseOptions, solve_pose
from ladarreg_core.pose.estimators.unknown_intrinsics import intrinsic
from testing.scenes.pose_case import Case
from testing.scenes.room import ROOM_CAMERA, room_case

SETTINGS = ((0.0, True), (0.3, False))
"""Share of outliers, and whether the noise is stated."""
WRONG_FOCAL = replace(ROOM_CAMERA, fx=1.03 * ROOM_CAMERA.fx, fy=1.03 * ROOM_CAMERA.fy)
LENS = replace(ROOM_CAMERA, distortion=(-0.1, 0.0, 0.0, 0.0))
PAIRS: dict[str, tuple[Camera, Camera, str | None]] = {
    "f 3 % too long": (ROOM_CAMERA, WRONG_FOCAL, "focal_px"),
    "k1 = -.1 given as 0": (LENS, ROOM_CAMERA, "k1"),
    "the right camera": (ROOM_CAMERA, ROOM_CAMERA, None),
}
"""True camera, stated camera, and the wrong parameter."""
OWN_SIGMAS = 3.0
MIN_WITHIN, MAX_FALSE = 98.0, 1.0


@dataclass(frozen=True)
class Outcome:
    """One case with the stated camera, and with the estimated one."""

    fixed_mm: float
    """Error of the camera position with the stated camera."""
    chosen_mm: float
    """Error of the camera position with the estimated camera."""
    adopted: bool
    """Whether any intrinsic was changed."""
    off_sigmas: float
    """|error| of the wrong intrinsic in its own standard deviations; infinite where it was kept."""


def outcome(case: Case, given: Camera, wrong: str | None, *, stated: bool) -> Outcome:
    """Solve a case with the stated camera, and with automatic intrinsics."""
    noise = {"sigma_px": case.sigma_px, "sigma_range_m": case.sigma_range_m} if stated else {}
    try:
        fixed, chosen = (
            solve_pose(case.matches, given, PoseOptions(intrinsics=intrinsics, **noise))  # type: ignore[arg-type]
            for intrinsics in ("fixed", "auto")
        )
    except LadarregError:
        return Outcome(np.inf, np.inf, False, np.inf)
    off = np.inf
    if wrong is not None and wrong in chosen.camera_sigmas:
        off = abs(intrinsic(chosen.camera, wrong) - intrinsic(case.camera, wrong)) / chosen.camera_sigmas[wrong]
    return Outcome(
        1000 * fixed.camera_from_scanner.distance_to(case.pose),
        1000 * chosen.camera_from_scanner.distance_to(case.pose),
        bool(chosen.camera_sigmas),
        float(off),
    )


def intrinsics_section(seeds: Sequence[int]) -> Section:
    """Report the share of estimated cameras, and the gain."""
    tables, figures, bars = [], {}, []
    heads = ("fixed: median mm", "estimated: median mm", f"within {OWN_SIGMAS:g} own sigmas", "adopted")
    for name, (true, given, wrong) in PAIRS.items():
        rows = []
        for outliers, stated in SETTINGS:
            where = f"{percent(outliers, 0)} mismatches, noise {'stated' if stated else 'not stated'}"
            outcomes = [
                outcome(room_case(seed, outliers=outliers, camera=true), given, wrong, stated=stated) for seed in seeds
            ]
            fixed, chosen = (float(np.median([getattr(o, n) for o in outcomes])) for n in ("fixed_mm", "chosen_mm"))
            within = float(np.mean([o.off_sigmas <= OWN_SIGMAS for o in outcomes])) if wrong else np.nan
            adopted = float(np.mean([o.adopted for o in outcomes]))
            rows.append((where, number(fixed, 1), number(chosen, 1), percent(within), percent(adopted)))
            figures[f"{name}, {where}"] = {
                "fixed_mm": fixed, "estimated_mm": chosen, "within_3_sigmas": within, "adopted": adopted
            }  # fmt: skip
            if wrong == "focal_px":
                bars.append(Bar(f"{name}, {where}: f within 3 own sigmas, %", 100 * within, least=MIN_WITHIN, digits=1))
            if wrong is None:
                bars.append(Bar(f"{name}, {where}: adopted falsely, %", 100 * adopted, most=MAX_FALSE, digits=1))
        tables.append((name, table(heads, rows)))
    return Section(
        "intrinsics",
        "Intrinsics (room, n = 200)",
        "The pose with the camera as given, and with the focal length and k1 estimated where the matches ask for it "
        "(a score test, then held-out matches). The error is that of the camera's position. A case in which the wrong "
        "intrinsic was left alone counts as outside its sigmas.",
        tuple(tables),
        tuple(bars),
        figures,
    )
