"""Snapping of drawn lines measured: how far their ends are from the true edges, with and without it.

    python -m benchmarks.page.snapping [--seeds N] [--first-seed K] [--json FILE]

Twenty edges of each simulated room are drawn in both panes with noise of every end, at one image pixel per screen
pixel. The error of an end is its distance from the true edge, which the room's model gives.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.page.snapping_lines import DrawnScene, drawn_scene, normals_of
from ladarreg_core.errors import LadarregError
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.inspection.corners import gray_of_photo, gray_of_view
from ladarreg_core.inspection.snapping import PhotoSnapper, ViewSnapper
from ladarreg_core.matches import Pick
from ladarreg_core.picks.measure import matches_from_picks
from ladarreg_core.pose.estimate import solve_pose
from ladarreg_core.simulate import SCENES

LINES = 20
NOISES_PX = (0.5, 2.0)
MAX_SHARE = {0.5: 2 / 3, 2.0: 0.5}
"""Largest median error with snapping over the one without, by noise."""
MAX_ALONG_PX = 0.05
FAR_PX = 8.0
"""An end this far from every edge stays where it is."""
_FLAT_PX, _FLAT_LEVELS = 6.5, 2.5
_POSE_LEAST = 6

Line = NDArray[np.float64]
Snap = Callable[[Line], Line | None]


@dataclass(frozen=True)
class SnappingFigures:
    """What snapping does to the lines of one scene, over several rooms."""

    scene: str
    noise_px: float
    ends: int
    drawn_px: dict[str, float]
    """Median error of the drawn ends, by pane and in both."""
    snapped_px: dict[str, float]
    """The same with snapping."""
    found: float
    """Share of the lines that snapped."""
    worst_along_px: float
    """Largest movement along an edge."""
    drawn_mm: float
    """Median error of the position that the lines determine."""
    snapped_mm: float
    drawn_deg: float
    """Median error of the orientation."""
    snapped_deg: float

    @property
    def share(self) -> float:
        """Median error with snapping over that without."""
        return self.snapped_px["both"] / self.drawn_px["both"]


def measure(scenes: Sequence[DrawnScene], name: str, noise_px: float) -> SnappingFigures:
    """Draw the lines of several rooms with noise, snap them, and compare."""
    errors: dict[str, list[list[float]]] = {"scan": [[], []], "photo": [[], []]}
    along, found, count = [0.0], 0, 0
    poses: list[list[tuple[float, float]]] = [[], []]
    for k, scene in enumerate(scenes):
        rng = np.random.default_rng([k, round(10 * noise_px)])
        lines: list[dict[str, NDArray[np.float64]]] = [{}, {}]
        for pane, (true, snap) in panes_of(scene).items():
            drawn = true + rng.normal(0, noise_px, true.shape)
            snapped = drawn.copy()
            for row, line in enumerate(drawn):
                moved = snap(line)
                count += 1
                if moved is not None:
                    snapped[row], found = moved, found + 1
            for which, ends in enumerate((drawn, snapped)):
                errors[pane][which].extend(across(ends, true).ravel())
                lines[which][pane] = ends
            along.append(_along(snapped, drawn))
        solved = [_pose_error(scene, each) for each in lines]
        if None not in solved:
            for which, error in enumerate(solved):
                poses[which].append(error)  # type: ignore[arg-type]
    both = [errors["scan"][which] + errors["photo"][which] for which in (0, 1)]
    medians = [
        {"scan": _median(errors["scan"][w]), "photo": _median(errors["photo"][w]), "both": _median(both[w])}
        for w in (0, 1)
    ]
    mm, deg = (([_median([p[axis] for p in each]) for each in poses]) for axis in (0, 1))
    return SnappingFigures(
        name, noise_px, len(both[0]), medians[0], medians[1], found / count, max(along), mm[0], mm[1], deg[0], deg[1]
    )


def panes_of(scene: DrawnScene) -> dict[str, tuple[Line, Snap]]:
    """Return the true lines and the snapping of both panes."""
    return {
        "scan": (scene.scan, ViewSnapper.of(scene.view).line),
        "photo": (scene.photo, PhotoSnapper.of(scene.case.photo).line),
    }


def across(ends: FloatArray, true: FloatArray) -> NDArray[np.float64]:
    """Return the distances (N, 2) of ends (N, 2, 2) from the true edges."""
    return np.asarray(np.abs(np.einsum("nei,ni->ne", ends - true[:, :1], normals_of(true))))


def far_lines(scene: DrawnScene) -> dict[str, list[Line]]:
    """Return lines parallel to the true edges and 8 px beside them where the picture is flat, by pane."""
    grays = {"scan": gray_of_view(scene.view), "photo": gray_of_photo(scene.case.photo)}
    found: dict[str, list[Line]] = {}
    for pane, true in (("scan", scene.scan), ("photo", scene.photo)):
        beside = np.concatenate([true + sign * FAR_PX * normals_of(true)[:, None] for sign in (-1, 1)])
        found[pane] = [line for line in beside if _flat(grays[pane], line)]
    return found


def _flat(gray: FloatArray, line: Line) -> bool:
    """Return whether nothing but noise is within reach of a line."""
    s, offsets = np.linspace(-0.05, 1.05, 80), np.arange(-_FLAT_PX, _FLAT_PX + 0.5, 0.5)
    at = line[0] + s[:, None, None] * (line[1] - line[0]) + offsets[:, None] * normals_of(line[None])[0]
    at = at.astype(np.float32)
    inside = (at >= 0) & (at <= np.array(gray.shape[::-1]) - 1)
    profile = np.asarray(cv2.remap(gray, at[..., 0], at[..., 1], cv2.INTER_LINEAR)).mean(axis=0)
    return bool(inside.all() and np.ptp(profile) < _FLAT_LEVELS)


def _along(snapped: FloatArray, drawn: FloatArray) -> float:
    """Return the largest movement along the edges that the lines snapped to."""
    direction = snapped[:, 1] - snapped[:, 0]
    direction = direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    return float(np.abs(np.einsum("nei,ni->ne", snapped - drawn, direction)).max(initial=0.0))


def _pose_error(scene: DrawnScene, lines: dict[str, NDArray[np.float64]]) -> tuple[float, float] | None:
    """Return the error of the pose that the lines determine, mm and degrees; None without a pose."""
    if len(lines["scan"]) < _POSE_LEAST:
        return None
    picks = [
        Pick(f"line-{k}", "line", scene.view.rays_at(scan), photo)
        for k, (scan, photo) in enumerate(zip(lines["scan"], lines["photo"], strict=True))
    ]
    camera, truth = scene.case.photo.camera, scene.case.camera_from_scanner
    try:
        matches, _ = matches_from_picks(scene.case.scan, picks, camera=camera)
        pose = solve_pose(matches, camera).camera_from_scanner
    except LadarregError:
        return None
    turn = truth.rotation @ pose.rotation.T
    angle = np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))
    return 1000 * float(np.linalg.norm(pose.centre - truth.centre)), float(angle)


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if len(values) else float("nan")


def failures(figures: Sequence[SnappingFigures], far_moved: int) -> list[str]:
    """Return the bars that are not met, as sentences."""
    missed = []
    for f in figures:
        where = f"{f.scene} at {f.noise_px:g} px"
        if f.share > MAX_SHARE[f.noise_px]:
            missed.append(f"{where}: the median error is {f.share:.2f} of the drawn one")
        if f.worst_along_px > MAX_ALONG_PX:
            missed.append(f"{where}: an end moved {f.worst_along_px:.2f} px along its edge")
        if not f.snapped_mm <= f.drawn_mm:
            missed.append(f"{where}: the pose got worse, {f.drawn_mm:.1f} to {f.snapped_mm:.1f} mm")
    if far_moved:
        missed.append(f"{far_moved} ends moved that were 8 px from any edge")
    return missed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    figures, far, far_moved = [], 0, 0
    for name in SCENES:
        seeds = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
        scenes = [drawn_scene(name, seed, lines=LINES) for seed in seeds]
        figures += [measure(scenes, name, noise) for noise in NOISES_PX]
        for scene in scenes:
            snaps = panes_of(scene)
            for pane, lines in far_lines(scene).items():
                far += 2 * len(lines)
                far_moved += 2 * sum(snaps[pane][1](line) is not None for line in lines)
    print("| scene | noise px | ends | drawn px | snapped px | share | scan | photo | pose mm | pose deg | along px |")
    print("|---|---|---|---|---|---|---|---|---|---|---|")
    for f in figures:
        shares = [f.snapped_px[pane] / f.drawn_px[pane] for pane in ("both", "scan", "photo")]
        print(
            f"| {f.scene} | {f.noise_px:g} | {f.ends} | {f.drawn_px['both']:.2f} | {f.snapped_px['both']:.2f} "
            f"| {shares[0]:.2f} | {shares[1]:.2f} | {shares[2]:.2f} | {f.drawn_mm:.1f} -> {f.snapped_mm:.1f} "
            f"| {f.drawn_deg:.3f} -> {f.snapped_deg:.3f} | {f.worst_along_px:.3f} |"
        )
    print(f"\n{far} ends 8 px from any edge: {far_moved} moved")
    missed = failures(figures, far_moved)
    print("\n".join(missed) or "every bar is met")
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(f) for f in figures], indent=1))


if __name__ == "__main__":
    main()
