"""Lines drawn by simulated hands: what becomes of the verdict, python -m benchmarks.drawn_hands [--cases N].

A hand draws eight legible edges of a simulated room in both panes as they are shown when a file was opened. Its ends
miss by 1, 2 or 4 px in each picture, twice as far along the edge as across it, and one line of ten lies along a wrong
edge in the photograph: both ends are off by the same 6 to 25 px, as by the thickness of a shelf.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

import ladarreg_core as lr
from benchmarks.page.snapping_lines import DrawnScene, drawn_scene
from ladarreg_core.errors import LadarregError
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Pick
from ladarreg_core.results.registration import Registration
from testing.scenes.pose_case import difference

SCENES = ("boxes", "desk", "office", "people")
SCATTERS_PX = (1.0, 2.0, 4.0)
LINES, MIN_LINES = 8, 6
_WRONG_SHARE = 0.1
_WRONG_PX = (6.0, 25.0)
_ALONG = 2.0
_HANDS = 3
FAR_SIGMAS = 5.0
RIGHT_PX = 8.0
"""Median displacement in the photograph below which a pose is right, px."""


@dataclass(frozen=True, slots=True)
class HandOutcome:
    """What became of one hand's lines."""

    scene: str
    scatter_px: float
    wrong: int
    """Number of lines along a wrong edge."""
    end: str
    """`image`, `statistics`, `contradicted`, `refused` or `no pose`."""
    position_mm: float
    sigma_mm: float
    sigmas: float
    """Mahalanobis distance of the pose from the true one over sqrt 6."""
    drawn_sigmas: float
    """The same of the pose as drawn."""
    drawn_accepted: bool
    """Whether the matches alone would do."""
    error_px: float
    reason: str


def hand(
    drawn: DrawnScene, scatter_px: float, rng: np.random.Generator, *, wrong_share: float
) -> tuple[list[Pick], int]:
    """Return the lines of a hand as picks, and how many of them lie along a wrong edge."""
    wrong = rng.random(len(drawn.photo)) < wrong_share
    scan = drawn.scan + _misses(drawn.scan, scatter_px, rng)
    photo = drawn.photo + _misses(drawn.photo, scatter_px, rng)
    off = rng.uniform(*_WRONG_PX, len(photo)) * rng.choice([-1, 1], len(photo)) * wrong
    photo += (off[:, None] * _across(drawn.photo))[:, None]
    picks = [Pick(str(k), "line", drawn.view.rays_at(scan[k]), photo[k]) for k in range(len(photo))]
    return picks, int(wrong.sum())


def _across(ends: FloatArray) -> FloatArray:
    along = ends[:, 1] - ends[:, 0]
    return np.stack([-along[:, 1], along[:, 0]], axis=1) / np.linalg.norm(along, axis=1, keepdims=True)


def _misses(ends: FloatArray, scatter_px: float, rng: np.random.Generator) -> FloatArray:
    across = _across(ends)
    along = np.stack([across[:, 1], -across[:, 0]], axis=1)
    by = rng.normal(0, scatter_px, (2, *ends.shape[:2]))
    return np.asarray(by[0][..., None] * across[:, None] + _ALONG * by[1][..., None] * along[:, None])


def outcome(scene: str, drawn: DrawnScene, scatter_px: float, picks: Sequence[Pick], wrong: int) -> HandOutcome:
    """Solve the lines of a hand, as the page does, and compare the pose with the true one."""
    scan, photo, truth = drawn.case.scan, drawn.case.photo, drawn.case.camera_from_scanner
    nan = float("nan")
    try:
        result, matched = _solved(scan, photo, picks)
    except LadarregError as error:
        return HandOutcome(scene, scatter_px, wrong, "no pose", nan, nan, nan, nan, False, nan, str(error))
    pose = result.camera_from_scanner
    verification = result.diagnostics.get("verification") or {}
    contradicted = verification.get("outcome") == "contradicted"
    end = result.evidence if result.accepted else "contradicted" if contradicted else "refused"
    return HandOutcome(
        scene, scatter_px, wrong, end,
        position_mm=1000 * pose.distance_to(truth),
        sigma_mm=1000 * result.sigma_position_m,
        sigmas=_sigmas(pose, result.covariance, truth),
        drawn_sigmas=_sigmas(matched.camera_from_scanner, matched.covariance, truth),
        drawn_accepted=matched.diagnostics["statistics"]["accepted"],
        error_px=_error_px(drawn, pose),
        reason=" ".join(result.reasons),
    )  # fmt: skip


def _solved(scan: lr.Scan, photo: lr.Photo, picks: Sequence[Pick]) -> tuple[Registration, Registration]:
    """Return the pose that is proposed of the lines, and that of the lines as they were drawn."""
    as_drawn = lr.RegisterOptions(proposal="drawn")
    return lr.register(scan, photo, picks=picks), lr.register(scan, photo, picks=picks, options=as_drawn)


def _sigmas(pose: Rigid, covariance: FloatArray, truth: Rigid) -> float:
    off = difference(truth, pose)
    return float(np.sqrt(off @ np.linalg.pinv(covariance, hermitian=True) @ off / 6))


def _error_px(drawn: DrawnScene, pose: Rigid) -> float:
    case = drawn.case
    points = case.scan.points[case.scan.valid].astype(np.float64)[::11]
    there = case.true_camera.project(case.camera_from_scanner @ points)
    seen = case.true_camera.contains(there)
    off = np.linalg.norm(case.true_camera.project(pose @ points[seen]) - there[seen], axis=1)
    return float(np.median(np.where(np.isfinite(off), off, np.inf)))


def hands(seeds: range) -> Iterator[HandOutcome]:
    """Yield what becomes of the hands in every scene."""
    for seed in seeds:
        for scene in SCENES:
            drawn = drawn_scene(scene, seed, lines=LINES)
            if len(drawn.photo) < MIN_LINES:
                continue
            for k, scatter_px in enumerate(SCATTERS_PX * _HANDS):
                rng = np.random.default_rng([seed, SCENES.index(scene), k, 39])
                picks, wrong = hand(drawn, scatter_px, rng, wrong_share=_WRONG_SHARE)
                yield outcome(scene, drawn, scatter_px, picks, wrong)


def table(found: Sequence[HandOutcome]) -> str:
    """Return the figures by scatter, and of all hands, as a table."""
    lines = [
        "| scatter, px | hands | verified | matches only | contradicted | refused | accepted and wrong "
        "| rms sigmas, accepted | beyond 5, accepted | rms sigmas, drawn |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, of in [*((f"{s:g}", [one for one in found if one.scatter_px == s]) for s in SCATTERS_PX), ("all", found)]:
        ends = Counter(one.end for one in of)
        accepted = [one for one in of if one.end in ("image", "statistics")]
        far = sum(one.sigmas > FAR_SIGMAS for one in accepted)
        drawn = [one.drawn_sigmas for one in of if one.drawn_accepted]
        lines.append(
            f"| {name} | {len(of)} | {ends['image']} | {ends['statistics']} | {ends['contradicted']} | "
            f"{ends['refused'] + ends['no pose']} | {sum(one.error_px > RIGHT_PX for one in accepted)} | "
            f"{_rms([one.sigmas for one in accepted]):.2f} | {far} | {_rms(drawn):.2f} of {len(drawn)} |"
        )
    return "\n".join(lines)


def _rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if values else float("nan")


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=6, help="rooms of each scene")
    parser.add_argument("--first", type=int, default=300, help="first seed")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    found = []
    for one in hands(range(arguments.first, arguments.first + arguments.cases)):
        found.append(one)
        print(one, flush=True)
    print(table(found))
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(one) for one in found]))


if __name__ == "__main__":
    main()
