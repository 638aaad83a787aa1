"""Problems with one to four defects end in a clear error, a refusal with reasons, or the correct pose."""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import event, given, settings
from hypothesis import strategies as st

from ladarreg_core.camera import Camera
from ladarreg_core.errors import LadarregError
from ladarreg_core.frames import Rigid, look_along, rotation_from_rotvec
from ladarreg_core.matches import Matches
from ladarreg_core.pose.estimate import PoseOptions, solve_pose
from ladarreg_core.results.registration import PoseResult
from ladarreg_core.thesis.estimators.stereo_simplex import SimplexOptions
from testing.scenes.pose_case import difference
from testing.scenes.room import ROOM_CAMERA, room_case

LENSES = {
    "room": ROOM_CAMERA,
    "distorted": Camera(768, 512, 700.0, 640.0, 380.0, 260.0, (-0.28, 0.11, 1e-3, -7e-4, -0.02)),
    "folding": Camera(768, 512, 700.0, 700.0, 383.5, 255.5, (-0.6, 0.0, 0.0, 0.0)),
    "tele": Camera.from_focal(768, 512, 6000.0),
    "fish": Camera.from_focal(768, 512, 90.0),
    "sliver": Camera(4000, 3, 900.0, 900.0, 1999.5, 1.0),
}
KINDS: dict[str, tuple[Any, ...]] = {
    "scene": (
        "wall", "oblique wall", "relief of 2 cm", "edge", "rod", "dot", "two dots", "two clusters", "three dots",
        "line and a point", "shell", "all around", "steps", "behind",
    ),
    "pixels": (
        "exact", "rounded", "random", "shuffled", "one", "two", "column", "mirrored", "turned", "half random",
        "most random", "half shifted", "half elsewhere", "far", "centre", "few moved",
    ),
    "ranges": ("all equal", "millimetres", "short by a tenth", "one wild", "tiny", "exact", "shuffled", "drowned"),
    "spoilt": (
        "nan ray", "inf ray", "nan range", "inf range", "zero range", "negative range", "nan pixel", "inf pixel",
        "nan weight", "zero weight", "negative weight", "huge weight", "long ray", "no ray", "huge range",
        "nan direction",
    ),
    "weights": ("mild", "wild", "least", "most", "one counts", "ranges wild", "ranges nothing", "ranges all"),
    "lines": ("pairs", "odd directions", "all across", "all across odd", "no direction"),
    "lens": ("distorted", "folding", "tele", "fish", "sliver"),
    "stated lens": ("wrong", "other"),
    "n": (0, 1, 3, 4, 5, 6, 7, 8, 12, 13, 16, 60),
    "scale": (1e-6, 1e-3, 0.03, 30.0, 1e3, 1e6),
    "place": ("same", "far aside", "among", "overhead"),
    "copies": (True,),
    "sigma_px": (1.0, 1e-6, 0.01, 3.0, 30.0, 1e6),
    "sigma_range_m": (0.015, 1e-6, 0.15, 1.0, 1e6),
    "initial": ("truth", "behind", "far", "near"),
    "method": ("linear", "stereo_simplex", "epipolar_simplex"),
}  # fmt: skip
"""Possible defects of each kind."""
SOUND: dict[str, Any] = {
    "scene": "room", "pixels": "noisy", "ranges": "noisy", "spoilt": "no", "weights": "one", "lines": "none",
    "lens": "room", "stated lens": "true", "n": 30, "scale": 1.0, "place": "aside", "copies": False, "sigma_px": None,
    "sigma_range_m": None, "initial": None, "method": "robust",
}  # fmt: skip
STATED_PX, STATED_M = 1.0, 0.015
MAX_SIGMAS = 7.0


@dataclass(frozen=True)
class Problem:
    """Matches with their ground truth."""

    matches: Matches
    camera: Camera
    options: PoseOptions
    initial: Rigid | None
    pose: Rigid
    truth: str
    """`known`: only the true pose may be accepted; `none`: no pose may; `open`: the input itself is wrong."""
    labels: str


def scene(kind: str, n: int, rng: np.random.Generator) -> np.ndarray:
    """Return points (n, 3) in the scanner frame, m."""
    spread, ahead = rng.uniform(-1, 1, (n, 2)), np.array([4.0, 0.0, 0.0])
    if kind == "room":
        return room_case(int(rng.integers(1 << 30)), count=max(n, 1), sigma_range_m=0).matches.points[:n]
    if kind in ("wall", "oblique wall", "relief of 2 cm", "edge", "steps"):
        normal = {"oblique wall": 1.0, "edge": 3.0}.get(kind, 0.0)
        depth = {"relief of 2 cm": 0.02 * rng.uniform(-1, 1, n), "steps": 0.5 * (spread[:, 0] > 0)}.get(kind, 0.0)
        return np.column_stack([4 + normal * 0.3 * spread[:, 0] + depth, spread])
    if kind in ("rod", "line and a point"):
        rod = ahead + np.outer(spread[:, 0], [0.3, 1.0, 0.2])
        rod[: int(kind != "rod")] += [0.0, 0.1, 0.7]
        return rod
    if kind in ("dot", "two dots", "three dots"):
        dots = np.array([[4.0, 0.1, 0.2], [3.5, -0.8, 0.3], [4.4, 0.5, -0.6]])
        return dots[np.arange(n) % {"dot": 1, "two dots": 2, "three dots": 3}[kind]]
    if kind == "two clusters":
        return np.array([[3.5, 0.8, 0.2], [5.0, -0.9, 0.0]])[np.arange(n) % 2] + 0.02 * rng.normal(size=(n, 3))
    around = rng.normal(size=(n, 3))
    around /= np.linalg.norm(around, axis=1, keepdims=True)
    if kind == "shell":
        return 4 * (np.array([1.0, 0, 0]) + 0.3 * around)
    if kind == "all around":
        return around * rng.uniform(2, 6, (n, 1))
    return -np.column_stack([rng.uniform(2, 6, n), spread])  # behind


def seen(kind: str, true: np.ndarray, camera: Camera, rng: np.random.Generator) -> tuple[np.ndarray, str]:
    """Return pixels (n, 2) and the resulting `Problem.truth`."""
    n, size = len(true), np.array(camera.size)
    anywhere, half = rng.uniform([0, 0], size - 1, (n, 2)), (np.arange(n) % 2 == 0)[:, None]
    noisy = true + rng.normal(size=(n, 2)) * STATED_PX
    turn = rotation_from_rotvec([0, 0, rng.uniform(0, 2 * np.pi)])[:2, :2]
    found: dict[str, tuple[np.ndarray, str]] = {
        "noisy": (noisy, "known"),
        "exact": (true, "known"),
        "rounded": (np.rint(true), "known"),
        "random": (anywhere, "none"),
        "shuffled": (rng.permutation(noisy), "none"),
        "one": (np.tile(size / 3, (n, 1)), "none"),
        "two": (np.where(half, size / 3, size / 2), "none"),
        "column": (np.column_stack([np.full(n, 200.0), noisy[:, 1]]), "open"),
        "mirrored": ([size[0] - 1, 0] + noisy * [-1, 1], "none"),
        "turned": ((noisy - size / 2) @ turn.T + size / 2, "open"),  # consistent with a rolled camera
        "half random": (np.where(half, noisy, anywhere), "known"),
        "most random": (np.where((np.arange(n) % 5 == 0)[:, None], noisy, anywhere), "known"),
        "half shifted": (np.where(half, noisy, noisy + np.array([40, -25])), "known"),
        "half elsewhere": (np.where(half, noisy, (noisy - size / 2) @ turn.T + size / 2), "open"),
        "few moved": (np.where((np.arange(n) % 6 == 0)[:, None], anywhere, noisy), "known"),
        "far": (rng.normal(size=(n, 2)) * 1e6, "none"),
        "centre": (np.tile([camera.cx, camera.cy], (n, 1)) + 1e-9 * anywhere, "none"),
    }
    return found[kind]


def spoil(kind: str, fields: dict[str, np.ndarray], k: int) -> None:
    """Put one invalid number into the arrays of the matches."""
    if kind == "no" or not len(fields["ranges"]):
        return
    how, name = kind.split()
    value = {"nan": np.nan, "inf": np.inf, "zero": 0.0, "negative": -1.0, "huge": 1e200, "long": 2.0, "no": 0.0}[how]
    array = fields[
        {"ray": "rays", "range": "ranges", "pixel": "uv", "weight": "weights", "direction": "directions"}[name]
    ]
    array[k] = array[k] * value if how in ("long", "no") else value


@st.composite
def problems(draw: st.DrawFn) -> Problem:
    """Draw a sound problem with one to four defects."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    wrong = rng.permutation(list(KINDS))[: draw(st.integers(1, 4))]
    return made(rng, {name: KINDS[name][rng.integers(len(KINDS[name]))] for name in wrong})


def made(rng: np.random.Generator, kinds: dict[str, Any]) -> Problem:
    """Build a problem that is sound except for the given defects."""
    pick = SOUND | kinds
    n, scale, lens, ranged = pick["n"], pick["scale"], LENSES[pick["lens"]], pick["ranges"]
    points = scene(pick["scene"], n, rng)
    if pick["lens"] in ("tele", "sliver"):
        points = points * [1, *np.array(lens.size) / lens.focal_px / 1.2]
    pose = room_case(int(rng.integers(1 << 30)), count=1).pose
    middle = points.mean(axis=0) if n else np.zeros(3)
    centre = {"aside": 1, "same": 0, "far aside": 3}.get(pick["place"], 1) * pose.centre
    if pick["place"] in ("among", "overhead"):
        centre = middle + np.array([0.0, 0.0, 0.1 if pick["place"] == "among" else 3.1])
    away = middle - centre
    if pick["place"] != "among" and np.linalg.norm(away) > 1e-6:  # aim at the centroid of the scanned points
        pose = Rigid(rotation_from_rotvec(0.03 * rng.normal(size=3)) @ look_along(away), np.zeros(3))
    pose = Rigid.from_centre(pose.rotation, centre * scale)
    points = points * scale
    with np.errstate(all="ignore"):
        true = lens.project(pose @ points)
    unseen = ~np.isfinite(true).all(axis=1) | (np.abs(true) > 1e5).any(axis=1)
    true[unseen] = rng.uniform([0, 0], lens.size, (int(unseen.sum()), 2))
    uv, truth = seen(pick["pixels"], true, lens, rng)
    uv = np.array(uv, dtype=float)
    if pick["copies"] and n:
        index = rng.integers(0, max(1, n // 3), n)
        points, uv = points[index], uv[index]
    ranges = np.linalg.norm(points, axis=1)
    rays = points / np.maximum(ranges, 1e-300)[:, None]
    if ranged in ("noisy", "drowned"):
        noise = STATED_M * min(scale, 1) if ranged == "noisy" else 0.7 * ranges
        ranges = np.maximum(ranges + rng.normal(size=n) * noise, 1e-9)
    elif ranged == "all equal" and n:
        ranges = np.full(n, np.median(ranges))
    elif ranged == "one wild" and n:
        ranges[rng.integers(n)] *= 30
    elif ranged == "shuffled":
        ranges = rng.permutation(ranges)
    else:
        ranges = ranges * {"millimetres": 1000.0, "short by a tenth": 0.9, "tiny": 1e-9}.get(ranged, 1.0)
    fields = {"rays": rays, "ranges": ranges, "uv": uv, **weighted(rng, pick["weights"], n)}
    fields |= drawn(rng, pick["lines"], uv)
    spoil(pick["spoilt"], fields, int(rng.integers(max(n, 1))))
    camera = lens
    if pick["stated lens"] == "wrong":
        camera = replace(lens, fx=lens.fx * 1.3, fy=lens.fy * 1.3)
    elif pick["stated lens"] == "other":
        camera = LENSES[tuple(LENSES)[int(rng.integers(len(LENSES)))]]
    noisier = (pick["sigma_px"] or 1) < STATED_PX or (pick["sigma_range_m"] or 1) < STATED_M
    honest = (
        camera == lens and not noisier and ranged in ("noisy", "exact", "one wild")
        and pick["weights"] in ("one", "least") and pick["spoilt"] == "no"
        and pick["lens"] != "sliver" and np.count_nonzero(unseen) <= 0.1 * n
    )  # fmt: skip
    initial = {
        None: None,
        "truth": pose,
        "behind": Rigid.from_centre(rotation_from_rotvec([0, np.pi, 0]) @ pose.rotation, pose.centre),
        "far": Rigid(pose.rotation, pose.translation + 1e5),
        "near": Rigid.from_centre(rotation_from_rotvec(rng.normal(size=3) * 0.2) @ pose.rotation, pose.centre + 0.2),
    }[pick["initial"]]
    options = PoseOptions(
        method=pick["method"],
        sigma_px=pick["sigma_px"],
        sigma_range_m=pick["sigma_range_m"],
        simplex=SimplexOptions(most_evaluations=200, most_iterations=120, restarts=0, reject_rounds=2),
        seed=int(rng.integers(1 << 30)),
    )
    ids = tuple(str(k // 2) for k in range(n)) if pick["lines"] == "pairs" else ()
    matches = Matches(pick_ids=ids, **fields)  # type: ignore[arg-type]
    if truth == "known" and not honest:
        truth = "open"
    if pick["lens"] == "sliver" and pick["pixels"] == "mirrored":
        truth = "open"  # three rows of pixels barely determine the upright
    return Problem(matches, camera, options, initial, pose, truth, ", ".join(f"{k} {v}" for k, v in kinds.items()))


def weighted(rng: np.random.Generator, kind: str, n: int) -> dict[str, np.ndarray]:
    """Return weights of a kind, valid or extreme."""
    one = np.ones(n)
    weights = {
        "mild": rng.uniform(0.3, 3, n),
        "wild": 10 ** rng.uniform(-9, 9, n),
        "least": 1e-9 * one,
        "most": 1e9 * one,
        "one counts": np.where(np.arange(n) == 0, 1e9, 1e-9),
    }.get(kind, one)
    ranged = {
        "mild": rng.uniform(0.1, 10, n),
        "ranges wild": 10 ** rng.uniform(-9, 9, n),
        "ranges nothing": 1e-9 * one,
        "ranges all": 1e9 * one,
    }.get(kind, one)
    return {"weights": np.array(weights), "range_weights": np.array(ranged)}


def drawn(rng: np.random.Generator, kind: str, uv: np.ndarray) -> dict[str, np.ndarray]:
    """Return line directions, and which ends are known only across the line."""
    n = len(uv)
    angles = rng.uniform(0, 2 * np.pi, n)
    odd = np.column_stack([np.cos(angles), np.sin(angles)])
    nothing = {"directions": np.zeros((n, 2)), "across": np.zeros(n, np.bool_), "fractions": np.zeros(n)}
    if kind == "none":
        return nothing
    if kind == "no direction":
        return {**nothing, "across": np.arange(n) == 0}
    along = odd.copy()
    if kind == "pairs":
        partner = np.minimum(np.arange(n) ^ 1, n - 1)
        step = (uv[partner] - uv) * np.where(np.arange(n) % 2, -1, 1)[:, None]
        length = np.linalg.norm(step, axis=1, keepdims=True)
        along = np.where((length > 0) & (length < 1e300), step / np.where(length > 0, length, 1), odd)
    across = {"odd directions": angles < 2, "all across": angles < 9, "all across odd": angles < 9}.get(
        kind, angles < 0
    )
    if kind == "all across":
        along = np.tile([1.0, 0.0], (n, 1))
    fractions = (np.arange(n) % 2).astype(float) if kind == "pairs" else np.zeros(n)
    return {"directions": along, "across": np.asarray(across), "fractions": fractions}


WHAT_TO_DO = re.compile(r"\b(add|remove|give|check|use|correct|normalise|spread|state|must be|take|ranges are|draw)\b")


def one_sentence(text: str) -> bool:
    """Return whether a message is one line with one sentence that states what to do."""
    return "\n" not in text and not re.search(r"[.!?] +[A-Z]", text) and bool(WHAT_TO_DO.search(text))


def verify(problem: Problem) -> str:
    """Solve a problem and return its outcome; any but the three valid outcomes fails an assertion."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            result: PoseResult | None = solve_pose(
                problem.matches, problem.camera, problem.options, initial=problem.initial
            )
        except LadarregError as error:
            raised = error
            result = None
    if result is None:
        assert one_sentence(str(raised)), (str(raised), problem.labels)
        return type(raised).__name__
    assert result.reasons, problem.labels
    covariance = result.covariance
    assert np.isfinite(covariance).all(), problem.labels
    unit = np.sqrt(np.diag(covariance))
    assert (unit > 0).all(), problem.labels
    assert np.linalg.eigvalsh(covariance / np.outer(unit, unit)).min() > -1e-9, problem.labels
    assert np.isfinite(result.camera_from_scanner.matrix).all(), problem.labels
    if not result.accepted:
        assert result.evidence == "none"
        return "refused"
    right(result, problem)
    return "accepted"


def right(result: PoseResult, problem: Problem) -> None:
    """Assert that only the true pose is accepted, within the stated uncertainty."""
    assert problem.truth != "none", (problem.labels, result.reasons)
    if problem.truth == "open":
        return
    step = difference(problem.pose, result.camera_from_scanner)
    angle, position = np.linalg.norm(step[:3]), np.linalg.norm(step[3:])
    sigmas_off = angle / (result.sigma_angle_rad + 1e-6), position / (result.sigma_position_m + 1e-6)
    assert max(sigmas_off) < MAX_SIGMAS, (problem.labels, sigmas_off, result.reasons)
    well_determined = result.sigma_position_m < 0.02 * np.median(result.matches.ranges)
    if well_determined and (problem.options.sigma_range_m or 0) <= 3 * STATED_M:
        slack = result.covariance + np.diag([1e-6**2] * 6)
        sigmas = float(np.sqrt(step @ np.linalg.solve(slack, step)))
        # duplicates count as matches with independent noise
        copies = len(result.matches) / len(np.unique(result.matches.uv, axis=0))
        assert sigmas < MAX_SIGMAS * np.sqrt(copies), (problem.labels, sigmas, result.reasons)


@given(problem=problems())
@settings(max_examples=1000)
@pytest.mark.long
def test_a_thousand_degenerate_problems_end_honestly(problem: Problem) -> None:
    event(verify(problem))
