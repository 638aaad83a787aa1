"""Do two versions of the code judge poses alike? python -m benchmarks.pose.verdicts --against CHECKOUT [--cases N].

Every version solves the same cases: points with relief, on planes and nearly so, near a line, partly behind the camera,
repeated structure, mirrored photographs, drawn lines, wrong and distorting cameras, with up to 70 % mismatches and with
noise stated, misstated or left open. Compared are verdicts, inliers and poses; where verdicts differ, the truth says
which of the two is right. A case is right if a correct pose is accepted, or if a wrong or ambiguous one is not.

The file also runs by its path with another checkout on PYTHONPATH; that is how the other version solves the cases.
"""

from __future__ import annotations

import argparse
import os
import pickle
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_SIZES = (6, 8, 12, 16, 24, 40, 80, 200, 500, 2000)
_OFTEN = (0.03, 0.05, 0.07, 0.13, 0.16, 0.17, 0.14, 0.15, 0.06, 0.04)
_MISMATCHES = (0.0, 0.1, 0.3, 0.5, 0.7)
_STATED = ("stated", "open", "open", "half", "double", "fourfold", "range open")
_CORRECT_SIGMA, _CORRECT_OF_RANGE, _CORRECT_DEG = 6.0, 0.1, 2.0
_SAME_SIGMA = 0.1
_LOOK = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])  # along the scanner's X


@dataclass(slots=True)
class Case:
    """Matches with their truth."""

    name: str
    points: Floats
    """(M, 3), scanner frame, m, with range noise."""
    uv: Floats
    """(M, 2), px."""
    rotation: Floats
    """(3, 3) camera_from_scanner."""
    centre: Floats
    """(3,) m."""
    unique: bool = True
    """False if a second pose explains the matches by construction."""
    camera: Mapping[str, Any] = field(default_factory=dict)
    """Focal length and distortion that the solver is told."""
    options: Mapping[str, Any] = field(default_factory=dict)
    lines: bool = False
    """True if neighbouring matches are the ends of drawn lines."""
    initial: tuple[Floats, Floats] | None = None
    """Rotation and centre of an initial pose."""


@dataclass(slots=True)
class Outcome:
    """What a version makes of a case."""

    verdict: str
    """`accepted`, `ambiguous`, `refused` or the name of the error."""
    reasons: tuple[str, ...] = ()
    rotation: Floats | None = None
    centre: Floats | None = None
    covariance: Floats | None = None
    inliers: NDArray[np.bool_] | None = None
    sigma: tuple[float, float] = (0.0, 0.0)


def _rotated(w: Floats) -> Floats:
    angle = float(np.linalg.norm(w))
    x, y, z = w / max(angle, 1e-12)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K)


def _relief(rng: np.random.Generator, n: int) -> Floats:
    return np.column_stack([rng.uniform(2, 6, n), rng.uniform(-1, 1, n), rng.uniform(-0.8, 0.8, n)])


def _on_plane(rng: np.random.Generator, n: int, *, relief: float, tilt_deg: float, far: float, half: float) -> Floats:
    flat = np.column_stack([relief * half * rng.uniform(-1, 1, n), rng.uniform(-half, half, (n, 2))])
    angle = np.deg2rad(tilt_deg)
    turn = _rotated(np.array([0.0, 0.0, angle])) @ _rotated(np.array([0.0, angle * rng.uniform(-1, 1), 0.0]))
    return np.asarray(flat @ turn.T + [far, 0.0, 0.0])


def _near_line(rng: np.random.Generator, n: int, *, width: float) -> Floats:
    along = rng.uniform(-1, 1, n)
    direction = np.array([0.6, 0.7, 0.3])
    return np.asarray(np.array([4.0, 0, 0]) + along[:, None] * direction + rng.normal(0, width, (n, 3)))


_SHAPES: dict[str, Callable[[np.random.Generator, int], Floats]] = {
    "relief": _relief,
    "plane": lambda rng, n: _on_plane(rng, n, relief=0, tilt_deg=rng.uniform(15, 60), far=4, half=1),
    "plane face on": lambda rng, n: _on_plane(rng, n, relief=0, tilt_deg=rng.uniform(0, 5), far=4, half=1),
    "plane far": lambda rng, n: _on_plane(rng, n, relief=0, tilt_deg=rng.uniform(5, 50), far=12, half=0.5),
    "plane small": lambda rng, n: _on_plane(
        rng,
        n,
        relief=rng.uniform(0, 0.1),
        tilt_deg=rng.uniform(10, 50),
        far=rng.uniform(5, 20),
        half=rng.uniform(0.3, 1),
    ),
    "nearly plane": lambda rng, n: _on_plane(
        rng, n, relief=rng.uniform(0.01, 0.4), tilt_deg=rng.uniform(0, 50), far=rng.uniform(3, 8), half=1
    ),
    "line": lambda rng, n: _near_line(rng, n, width=0.0),
    "near a line": lambda rng, n: _near_line(rng, n, width=10 ** rng.uniform(-3, -0.7)),
}
_KINDS = (
    "relief", "relief", "relief", "plane", "plane", "plane face on", "plane far", "plane small", "plane small",
    "nearly plane", "nearly plane", "line", "near a line", "behind", "repeated", "repeated", "mirrored", "duplicates",
    "random", "wrong focal", "distorted", "lines", "initial", "no baseline", "at the edge",
)  # fmt: skip
_SELDOM_WRONG = ("plane far", "plane small", "repeated", "lines")  # what else is wrong would hide their ambiguity


def _distorted(uv: Floats, f: float, k1: float) -> Floats:
    xy = (uv - [383.5, 255.5]) / f
    return np.asarray(xy * (1 + k1 * (xy * xy).sum(axis=1, keepdims=True)) * f + [383.5, 255.5])


def case(index: int) -> Case:
    """Return a case by its number."""
    rng = np.random.default_rng([20, index])
    kind = _KINDS[index % len(_KINDS)]
    n = int(rng.choice(_SIZES, p=_OFTEN))
    share = float(rng.choice(_MISMATCHES))
    noise_px, noise_m = 10 ** rng.uniform(-0.5, 0.4), 10 ** rng.uniform(-2.5, -1.5)
    if kind in _SELDOM_WRONG:
        share = min(share, float(rng.choice([0.0, 0.1, 0.3])))
    f = 974.0
    points = _SHAPES.get(kind, _relief)(rng, n)
    rotation = _rotated(rng.normal(0, 0.08, 3)) @ _LOOK
    centre = rng.normal(0, 0.3, 3) * (kind != "no baseline")
    p = (points - centre) @ rotation.T
    uv = p[:, :2] / np.where(np.abs(p[:, 2:]) > 0.01, p[:, 2:], 0.01) * f + [383.5, 255.5]
    unique, lines, initial = True, False, None
    camera: dict[str, Any] = {}
    if kind == "behind":
        behind = rng.random(n) < rng.choice([0.1, 0.3, 0.6])
        points[behind] = 2 * centre - points[behind]  # projects to the same pixels, from behind
    elif kind == "repeated":
        moved = rng.random(n) < rng.choice([0.3, 0.35, 0.4, 0.45])
        share = 0.0
        q = (points - centre - [0.0, 0.7, 0.0]) @ rotation.T
        uv[moved] = (q[:, :2] / q[:, 2:] * f + [383.5, 255.5])[moved]
        unique = bool(np.mean(moved) < 1 / 3)
    elif kind == "mirrored":
        points = _on_plane(rng, n, relief=0, tilt_deg=rng.uniform(10, 40), far=4, half=1)
        p = (points - centre) @ rotation.T
        uv = p[:, :2] / p[:, 2:] * f * [-1, 1] + [383.5, 255.5]
        unique = False
    elif kind == "duplicates":
        points, uv = (np.repeat(each[: max(n // 4, 1)], 4, axis=0)[:n] for each in (points, uv))
        n = len(points)
    elif kind == "random":
        share, unique = 1.0, False
    elif kind == "wrong focal":
        camera = {"f": f * (1 + rng.choice([-0.05, -0.03, -0.01, 0.01, 0.03]))}
    elif kind == "distorted":
        k1 = float(rng.uniform(-0.2, 0.1))
        uv, camera = _distorted(uv, f, k1), {"k1": k1 * float(rng.choice([1, 1, 0]))}
    elif kind == "lines":
        lines = True
    elif kind == "initial":
        initial = _rotated(rng.normal(0, 0.2, 3)) @ rotation, centre + rng.normal(0, 0.5, 3)
    elif kind == "at the edge":
        share = float(rng.choice([0.4, 0.45, 0.5, 0.55]))  # of acceptance
    noisy = kind != "duplicates"
    uv = uv + noisy * rng.normal(0, noise_px, (n, 2))
    wrong = rng.permutation(n)[: round(share * n)]
    uv[wrong] = rng.uniform(0, 1, (len(wrong), 2)) * [768, 512]
    away = points / np.linalg.norm(points, axis=1, keepdims=True)
    points = points + noisy * away * rng.normal(0, noise_m, (n, 1))
    stated = str(rng.choice(_STATED))
    factor = {"stated": 1.0, "half": 0.5, "double": 2.0, "fourfold": 4.0, "range open": 1.0}.get(stated)
    options: dict[str, Any] = {"seed": int(rng.integers(3))}
    if factor is not None:
        options["sigma_px"] = float(noise_px * factor)
        if stated != "range open":
            options["sigma_range_m"] = float(noise_m * factor)
    if index % 7 == 0:
        options["intrinsics"] = str(rng.choice(["fixed", "focal", "focal_k1"]))
    name = f"{index} {kind}, {n} matches, {share:.0%} wrong, noise {stated}"
    return Case(name, points, uv, rotation, centre, unique, camera, options, lines, initial)


def solve(each: Case) -> Outcome:
    """Return what the version on the path makes of a case."""
    import ladarreg_core as lr
    from ladarreg_core.errors import LadarregError
    from ladarreg_core.frames import Rigid
    from ladarreg_core.pose.estimate import PoseOptions, solve_pose

    camera = lr.Camera.from_focal(768, 512, each.camera.get("f", 974.0))
    if each.camera.get("k1"):
        camera = lr.Camera(768, 512, 974.0, 974.0, 383.5, 255.5, (each.camera["k1"], 0.0, 0.0, 0.0))
    initial = None if each.initial is None else Rigid.from_centre(*each.initial)
    ranges = np.linalg.norm(each.points, axis=1)
    rays = each.points / ranges[:, None]
    try:
        if each.lines:
            matches = _as_lines(rays, ranges, each.uv)
            found = solve_pose(matches, camera, PoseOptions(**each.options), initial=initial)
        else:
            found = lr.estimate_pose(rays, ranges, each.uv, camera, initial=initial, **each.options)
    except LadarregError as error:
        return Outcome(type(error).__name__, (str(error),))
    pose = found.camera_from_scanner
    ambiguous = bool(found.diagnostics.get("second_minimum"))
    verdict = "accepted" if found.accepted else "ambiguous" if ambiguous else "refused"
    return Outcome(
        verdict, tuple(found.reasons), pose.rotation, pose.centre, found.covariance, found.inliers,
        (found.sigma_px, found.sigma_range_m),
    )  # fmt: skip


def _as_lines(rays: Floats, ranges: Floats, uv: Floats) -> Any:
    """Return pairs of matches as the ends of lines, some drawn the other way round."""
    from ladarreg_core.matches import Matches

    even = len(rays) // 2 * 2
    rays, ranges, uv = rays[:even], ranges[:even], uv[:even].copy()
    uv[0:2] = uv[1::-1]
    along = uv[1::2] - uv[::2]
    along = along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    ids = tuple(f"L{k // 2}" for k in range(even))
    fractions = np.tile([0.0, 1.0], even // 2)
    return Matches(rays, ranges, uv, ids, fractions, directions=np.repeat(along, 2, axis=0))


def off_truth(each: Case, outcome: Outcome) -> float:
    """Return how far a pose is from the truth: 1 is the most that counts as correct, by its covariance or as such."""
    if outcome.rotation is None or outcome.centre is None or outcome.covariance is None:
        return float("inf")
    relative = each.rotation @ outcome.rotation.T
    w = np.array([relative[2, 1] - relative[1, 2], relative[0, 2] - relative[2, 0], relative[1, 0] - relative[0, 1]])
    shift = each.centre - outcome.centre
    angle = float(np.degrees(np.arccos(np.clip((np.trace(relative) - 1) / 2, -1, 1))))
    reach = float(np.median(np.linalg.norm(each.points, axis=1)))
    plain = max(angle / _CORRECT_DEG, float(np.linalg.norm(shift)) / (_CORRECT_OF_RANGE * reach))
    if angle > 30:
        return plain
    return min(plain, _in_sigmas(np.concatenate([w / 2, shift]), outcome.covariance) / _CORRECT_SIGMA)


def is_right(each: Case, outcome: Outcome) -> bool:
    """Return whether the truth supports a verdict: refusing a correct pose that is unique is wrong."""
    correct = off_truth(each, outcome) <= 1
    return (correct and each.unique) == (outcome.verdict == "accepted")


def _in_sigmas(step: Floats, covariance: Floats) -> float:
    unit = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    scaled = covariance / np.outer(unit, unit) + 1e-9 * np.eye(len(unit))
    off = step / unit
    return float(np.sqrt(max(off @ np.linalg.solve(scaled, off), 0.0)))


def apart(a: Outcome, b: Outcome) -> float:
    """Return the distance of two poses in standard deviations of the first."""
    if a.rotation is None or b.rotation is None or a.centre is None or b.centre is None or a.covariance is None:
        return 0.0 if a.rotation is b.rotation else float("inf")
    relative = b.rotation @ a.rotation.T
    w = np.array([relative[2, 1] - relative[1, 2], relative[0, 2] - relative[2, 0], relative[1, 0] - relative[0, 1]])
    return _in_sigmas(np.concatenate([w / 2, b.centre - a.centre]), a.covariance)


def record(path: Path, count: int, first: int) -> None:
    """Solve the cases and write the outcomes."""
    begin = time.process_time()
    outcomes = [solve(case(index)) for index in range(first, first + count)]
    path.write_bytes(pickle.dumps((outcomes, time.process_time() - begin)))


def outcomes_of(checkout: Path, count: int, first: int) -> tuple[list[Outcome], float]:
    """Return the outcomes of a checkout, solved in a process of its own, and the processor's seconds."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "outcomes"
        environment = {**os.environ, "PYTHONPATH": str(checkout.resolve())}
        subprocess.run(
            [sys.executable, __file__, "--record", str(path), "--cases", str(count), "--first", str(first)],
            env=environment, check=True,
        )  # fmt: skip
        outcomes, seconds = pickle.loads(path.read_bytes())
    return outcomes, seconds


def compare(before: list[Outcome], after: list[Outcome], first: int) -> Iterator[str]:
    """Yield what is alike and what differs, with the truth's opinion."""
    cases = [case(first + k) for k in range(len(before))]
    for name, outcomes in (("before", before), ("after", after)):
        counts = Counter(o.verdict for o in outcomes)
        right = sum(map(is_right, cases, outcomes))
        listed = ", ".join(f"{word} {number}" for word, number in sorted(counts.items()))
        yield f"{name}: {listed}; {right} of {len(cases)} verdicts right by the truth"
    same = [a.verdict == b.verdict for a, b in zip(before, after, strict=True)]
    yield f"verdicts that differ: {same.count(False)}"
    for each, a, b, equal in zip(cases, before, after, same, strict=True):
        if not equal:
            who = {(True, False): "before is right", (False, True): "after is right"}
            which = who.get((is_right(each, a), is_right(each, b)), "neither is right")
            yield f"  {each.name}: {a.verdict} -> {b.verdict}; {which} (off by {off_truth(each, a):.2f}, " + (
                f"{off_truth(each, b):.2f}); {(a.reasons or ('-',))[0]} -> {(b.reasons or ('-',))[0]}"
            )
    solved = [(e, a, b) for e, a, b in zip(cases, before, after, strict=True) if a.inliers is not None]
    solved = [(e, a, b) for e, a, b in solved if b.inliers is not None]
    inliers = [(e, a, b) for e, a, b in solved if not np.array_equal(a.inliers, b.inliers)]
    yield f"sets of inliers that differ: {len(inliers)} of {len(solved)}"
    far = np.array([apart(a, b) for _, a, b in solved])
    for word in ("accepted", "ambiguous", "refused"):
        of = np.array([apart(a, b) for _, a, b in solved if a.verdict == word == b.verdict])
        if len(of):
            yield (
                f"poses of {word}: median {np.median(of):.1e} sigma apart, 99 % within {np.quantile(of, 0.99):.1e}, "
                f"{np.count_nonzero(of > _SAME_SIGMA)} of {len(of)} by more than {_SAME_SIGMA}"
            )
    for (each, a, b), distance in zip(solved, far, strict=True):
        if distance > _SAME_SIGMA and a.verdict == "accepted" == b.verdict:
            yield f"  {each.name}: {distance:.2f} sigma; off by {off_truth(each, a):.2f} -> {off_truth(each, b):.2f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--against", type=Path, help="the other checkout")
    parser.add_argument("--cases", type=int, default=2000)
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--record", type=Path, help="only solve the cases, and write the outcomes here")
    arguments = parser.parse_args()
    if arguments.record:
        record(arguments.record, arguments.cases, arguments.first)
        return
    if not arguments.against:
        parser.error("give --against CHECKOUT")
    here = Path(__file__).resolve().parents[2]
    (before, took), (after, takes) = (
        outcomes_of(checkout, arguments.cases, arguments.first) for checkout in (arguments.against, here)
    )
    print(f"{arguments.cases} cases: {took:.1f} s of the processor before, {takes:.1f} s after")
    for line in compare(before, after, arguments.first):
        print(line)


if __name__ == "__main__":
    main()
