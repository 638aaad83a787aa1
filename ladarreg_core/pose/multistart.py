"""From how far away starts lead to a pose, and whether they lead anywhere else: the verdict from many starts.

Most of the descent is done on a sample of the matches and by all starts at once, while a cost closes that starts as
wide as each start is wrong. What then lies in one place goes on together, and only the places that explain the sample
are settled on all matches, beside the candidates that no start near the pose needs to find: the mirrored pose of a
plane, and the pose on which the matches agree that disagree with this one.

Source: the methods named in `gnc`, `ambiguity` and `ransac`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from ladarreg_core.arrays import BoolArray, FloatArray, IntArray
from ladarreg_core.errors import DegenerateGeometryError, OptionError
from ladarreg_core.formatting import length_in_words
from ladarreg_core.frames import Rigid, principal_extents
from ladarreg_core.pose.ambiguity import (
    APART_SIGMA,
    LIKELY,
    generalised,
    least_rival,
    likelihood_scores,
    mirrored,
    orbits,
    pose_of_the_others,
    steps_from,
    towards_mirrored,
)
from ladarreg_core.pose.bundle import (
    Measurements,
    States,
    information_matrix,
    residuals,
    rotations_from_rotvecs,
    settle,
)
from ladarreg_core.pose.covariance import LEAST_EIGENVALUE, guarded_inverse
from ladarreg_core.pose.gnc import DEFAULT_GNC, descended, gathered, graduate, narrow_scales, near_pairs
from ladarreg_core.pose.preconditions import LEAST_MATCHES
from ladarreg_core.results import PoseResult

BasinVerdict = Literal["unique", "ambiguous", "failed"]

HOME_SHARE = 0.9
"""A level belongs to the basin where at least this share of its starts comes home."""
_LEVELS_DEG = (5.0, 10.0, 20.0, 40.0)
_LEVELS_OF_DISTANCE = (1 / 16, 1 / 8, 1 / 4, 1 / 2)  # .25, .5, 1 and 2 m where the matches are 4 m away
_LEAST_STARTS, _MOST_STARTS = 8, 4096
_HARDLY = 0.25  # of the nearest starts
_SAMPLE, _MOST_SAMPLE = 40, 160  # among the matches that agree, and in all
_SAME_RAD, _SAME_OF_DISTANCE = np.deg2rad(4.0), 0.1  # one place is no larger, however little the matches say
_MOST_PLACES = 8
_ON_ALL = replace(DEFAULT_GNC, last_steps=8)
_FLAT = 0.3  # least over middle extent of points that may have a mirrored pose


@dataclass(frozen=True, slots=True)
class BasinLevel:
    """Starts that are equally far from the pose, in any direction."""

    angle_rad: float
    """How far they are turned, rad."""
    distance_m: float
    """How far they are moved, m."""
    starts: int
    """How many there are."""
    home: int
    """How many of them came home."""

    @property
    def share(self) -> float:
        """The share that came home."""
        return self.home / self.starts


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """A pose where descents end, or on the way to the mirrored one of a plane."""

    pose: Rigid
    """camera_from_scanner."""
    score: float
    """-2 log likelihood over all matches but for a constant, as `likelihood_scores`; lower is better."""
    agree: int
    """How many matches agree with it."""
    starts: int
    """How many of the perturbed starts ended there; 0 where only a candidate did."""


@dataclass(frozen=True, slots=True, eq=False)
class Basin:
    """What many starts say about a pose."""

    verdict: BasinVerdict
    """`unique`: no other place explains the matches; `ambiguous`: one does; `failed`: another is better, or no home."""
    levels: tuple[BasinLevel, ...]
    """From the nearest to the farthest."""
    places: tuple[Place, ...]
    """Those whose descents explain a sample of the matches, the best first."""
    starts: int
    """Number of perturbed starts."""
    pose: Rigid
    """The pose that was asked about."""
    other: Rigid | None
    """The pose that explains the matches as well (`ambiguous`) or better (`failed`), or None."""
    other_agree: int
    """How many matches agree with that, 0 where there is none."""
    agree: int
    """How many matches agree with the pose that was asked about."""
    matches: int
    """How many there are."""

    @property
    def size(self) -> BasinLevel | None:
        """The farthest level from which, as from all nearer ones, at least `HOME_SHARE` come home; None: no level."""
        reached = None
        for level in self.levels:
            if level.share < HOME_SHARE:
                break
            reached = level
        return reached

    def as_dict(self) -> dict[str, Any]:
        """Return the figures, JSON-ready."""
        levels = [
            {"angle_rad": level.angle_rad, "distance_m": level.distance_m, "starts": level.starts, "home": level.home}
            for level in self.levels
        ]
        size = self.size
        reached = None if size is None else {"angle_rad": size.angle_rad, "distance_m": size.distance_m}
        other = None if self.other is None else self.other.matrix.tolist()
        return {"verdict": self.verdict, "starts": self.starts, "levels": levels, "size": reached, "other": other}

    def in_words(self) -> str:
        """Return a sentence on what was found and what to do."""
        if self.other is not None:
            far, turned = self.pose.distance_to(self.other), np.degrees(self.pose.angle_to(self.other))
            where = f"{length_in_words(far)} and {turned:.2g}"
            if self.verdict == "ambiguous":
                return (
                    f"Two places explain the matches: a second pose lies {where} deg away "
                    f"({self.other_agree} matches agree with it, {self.agree} with this one). "
                    "Add matches off their plane or line, near and far, and check those that repeat."
                )
            count = f"{self.other_agree} of {self.matches} matches agree with it, {self.agree} with this one"
            why = count if self.other_agree > self.agree else "the same matches lie closer to it"
            return f"A better pose lies {where} deg away: {why}. Take that one, or solve again from it."
        nearest = self.levels[0]
        if self.verdict == "failed":
            return (
                f"Only {nearest.home} of {nearest.starts} starts {_far(nearest)} away lead back to this pose. "
                "Correct or remove mismatches, or add matches."
            )
        size = self.size
        if size is None:
            return (
                f"No other pose explains the matches, yet only {nearest.home} of {nearest.starts} starts "
                f"{_far(nearest)} away lead here. Correct or remove mismatches."
            )
        every = all(level.share == 1 for level in self.levels[: self.levels.index(size) + 1])
        return f"Starts up to {_far(size)} away {'all' if every else 'nearly all'} lead here, and to no other pose."


@dataclass(frozen=True, slots=True, eq=False)
class Confirmation:
    """What many starts made of a result."""

    result: PoseResult
    """The result with their verdict in its reasons and its diagnostics."""
    verdict: BasinVerdict | None
    """`unique`, `ambiguous` or `failed`; None where nothing was accepted that could be confirmed."""
    better: Rigid | None = None
    """A pose that explains the matches better, to solve again from."""


def probe_basin(result: PoseResult, *, starts: int = 32, seed: int = 0, gate_chi2: float = 9.21) -> Basin:
    """Return from how far away starts lead to a pose, and whether another explains its matches.

    The starts lie up to 40 degrees and half of the matches' distance away, any way; what is descended is the cost of
    `solve_pose` over all matches, those that disagree included.

    Args:
        result: a pose with its matches and their noise, found in any way.
        starts: how many, at least 8.
        seed: of the starts and the sample; the same input and seed give the same answer.
        gate_chi2: largest s of a match that agrees, as `PoseOptions.gate_chi2`.

    Raises:
        OptionError: if the starts, the seed or the gate have no meaning.
        DegenerateGeometryError: if there are fewer than 4 matches.
    """
    _check(result, starts, seed, gate_chi2)
    pose, points, gate = result.camera_from_scanner, result.matches.points, float(gate_chi2)
    measured = Measurements.of(
        result.matches, result.camera, sigma_px=result.sigma_px, sigma_range_m=result.sigma_range_m
    )
    reach = max(float(np.median(np.linalg.norm(pose @ points, axis=1))), 1e-9)
    given, seen = settle(measured, States.of([pose], measured), rounds=1)
    agree = seen.s[0] <= gate
    members = points[agree] if np.count_nonzero(agree) >= LEAST_MATCHES else points

    rng, share = np.random.default_rng(seed), max(float(np.mean(agree)), 1e-3)
    few = measured.subset(np.sort(rng.permutation(len(measured))[: min(_MOST_SAMPLE, round(_SAMPLE / share))]))
    level_of = np.sort(np.arange(starts) % len(_LEVELS_DEG))
    perturbed = _perturbed(pose, few, level_of, reach=reach, rng=rng)
    around = States.of(orbits(pose, members), few)
    ends, end_of = descended(few, perturbed.joined(around), gate=gate, reach=reach)
    worth = _worth_a_look(few, ends, gate=gate)

    another = pose_of_the_others(
        result.matches, measured, ~agree, result.camera, sigma_px=result.sigma_px, seed=seed
    )  # fmt: skip
    candidates = [pose] if another is None else [pose, another]
    settled = _settled(measured, candidates, ends.subset(worth), members, gate=gate)
    found = _places(measured, settled, gate=gate, reach=reach)
    there = np.full(len(ends.centres), -1)
    there[worth] = found.place_of[len(candidates) : len(candidates) + len(worth)]
    return _judged(
        result, found, there[end_of[:starts]], level_of,
        score=float(likelihood_scores(measured, given, gate)[0]), agree=int(np.count_nonzero(agree)), reach=reach,
    )  # fmt: skip


def confirm(result: PoseResult, *, starts: int = 32, seed: int = 0) -> Confirmation:
    """Probe the basin of an accepted pose; where another pose explains the matches too, it is accepted no more.

    Args:
        result: a pose with its matches. What is not accepted is returned as it is.
        starts: how many starts, at least.
        seed: of the starts.

    Raises:
        OptionError: if the starts or the seed have no meaning.
    """
    if not result.accepted:
        return Confirmation(result, None)
    basin = probe_basin(result, starts=starts, seed=seed)
    diagnostics = {**result.diagnostics, "basin": basin.as_dict()}
    if basin.verdict == "unique":
        confirmed = replace(result, reasons=(*result.reasons, basin.in_words()), diagnostics=diagnostics)
        return Confirmation(confirmed, basin.verdict)
    refused = replace(
        result, accepted=False, evidence="none", reasons=(basin.in_words(),), diagnostics=diagnostics
    )  # fmt: skip
    better = basin.other if basin.verdict == "failed" else None
    return Confirmation(refused, basin.verdict, better)


def _check(result: PoseResult, starts: int, seed: int, gate_chi2: float) -> None:
    for name, value, least, most in (("starts", starts, _LEAST_STARTS, _MOST_STARTS), ("seed", seed, 0, 2**31 - 1)):
        if isinstance(value, bool) or not isinstance(value, int | np.integer) or not least <= value <= most:
            raise OptionError(f"{name} is {value!r}; it must be a whole number from {least} to {most}")
    if not 1e-3 <= gate_chi2 <= 1e6:
        raise OptionError(f"gate_chi2 is {gate_chi2!r}; it must be a positive number")
    if len(result.matches) < LEAST_MATCHES:
        raise DegenerateGeometryError(
            f"there are {len(result.matches)} matches and a verdict needs {LEAST_MATCHES}; add matches"
        )


def _perturbed(pose: Rigid, few: Measurements, level_of: IntArray, *, reach: float, rng: np.random.Generator) -> States:
    axes, ways = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in rng.normal(size=(2, len(level_of), 3)))
    angles, distances = np.deg2rad(_LEVELS_DEG)[level_of], np.array(_LEVELS_OF_DISTANCE)[level_of] * reach
    return States(
        rotations_from_rotvecs(axes * angles[:, None]) @ pose.rotation,
        pose.centre + ways * distances[:, None],
        np.tile(few.ranges, (len(level_of), 1)),
    )


def _settled(
    measured: Measurements, candidates: list[Rigid], ends: States, members: FloatArray, *, gate: float
) -> States:
    """Return candidates and ends in that order, settled on all matches, then what a flat scene (N, 3) asks for."""
    extents = principal_extents(members)
    flat = bool(extents[2] <= _FLAT * extents[1])
    poses = [*candidates, *(ends.pose(k) for k in range(len(ends.centres)))]
    if flat:
        poses.append(mirrored(candidates[0], members))
    full = States.of(poses, measured)
    settled, _ = graduate(measured, full, narrow_scales(full, gate), gate, _ON_ALL)
    if not flat:
        return settled
    valley, _ = settle(measured, States.of(towards_mirrored(settled.pose(), members), measured))
    return settled.joined(generalised(measured, settled, gate)).joined(valley)


def _worth_a_look(few: Measurements, ends: States, *, gate: float) -> IntArray:
    """Return which ends on a sample may explain all matches, the best first."""
    s = residuals(few, ends).s
    scores = likelihood_scores(few, ends, gate)
    order = np.argsort(scores, kind="stable")[:_MOST_PLACES]
    # On all matches a rival may be higher by LIKELY, on a sample also by chance.
    most = scores[order[0]] + LIKELY * _noise(s[order[0]], gate) + 4 * np.sqrt(4 * len(few))
    return np.asarray(order[scores[order] <= most])


def _noise(s: FloatArray, gate: float) -> float:
    """Return chi^2/dof of the matches that agree, where it exceeds 1: by it differences of scores are judged."""
    inside = s[s <= gate]
    return max(1.0, float(inside.sum()) / max(2 * len(inside) - 6, 1))


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """The places on all matches; the best is the first."""

    states: States
    """(P,) the places."""
    scores: FloatArray
    """(P,) their `likelihood_scores`."""
    agree: BoolArray
    """(P, N) which matches agree with each."""
    information: FloatArray
    """(6, 6) at the best."""
    noise: float
    """chi^2/dof there, at least 1."""
    place_of: IntArray
    """The place of each state that was settled."""


def _places(measured: Measurements, settled: States, *, gate: float, reach: float) -> _Found:
    """Gather settled states into places."""
    s, scores = residuals(measured, settled).s, likelihood_scores(measured, settled, gate)
    best = np.array([int(np.argmin(scores))])
    H = information_matrix(measured, settled.subset(best), members=s[best[0]] <= gate)[0]
    noise = _noise(s[best[0]], gate)
    step = np.stack([steps_from(settled.pose(k), settled)[0] for k in range(len(scores))])
    near = near_pairs(settled, _SAME_RAD, _SAME_OF_DISTANCE * reach)
    near &= ((step @ H) * step).sum(axis=-1) <= APART_SIGMA**2 * noise
    place_of, leaders = gathered(near, scores)
    return _Found(settled.subset(leaders), scores[leaders], s[leaders] <= gate, H, noise, place_of)


def _differs(result: PoseResult, found: _Found, home: int) -> bool:
    """Return whether a pose lies further from its place than the noise of both explains."""
    step = steps_from(result.camera_from_scanner, found.states.subset(np.array([home])))[0][0]
    unit = 1 / np.sqrt(np.maximum(np.diag(found.information), 1e-300))
    C = guarded_inverse(found.information * np.outer(unit, unit)) * found.noise
    own = result.covariance / np.outer(unit, unit)
    if np.isfinite(own).all():
        C = C + own
    values, vectors = np.linalg.eigh((C + C.T) / 2)
    along = (step / unit) @ vectors
    return bool((along * along / np.maximum(values, LEAST_EIGENVALUE)).sum() > APART_SIGMA**2)


def _judged(
    result: PoseResult, found: _Found, ended: IntArray, level_of: IntArray, *, score: float, agree: int, reach: float
) -> Basin:
    """Weigh the places against each other.

    Args:
        result: the pose that was asked about.
        found: the places; the first state that was settled was that pose.
        ended: (starts,) the place of each start, -1: none that explains the matches.
        level_of: (starts,) the level of each.
        score: of the pose as it was given.
        agree: how many matches agree with it.
        reach: the distance of the matches from it, m.
    """
    home, margin = int(found.place_of[0]), LIKELY * found.noise
    other: int | None = None
    verdict: BasinVerdict = "unique"
    if found.scores[0] < found.scores[home] - margin:
        verdict, home, other = "failed", 0, 0
    elif score > found.scores[home] + margin and _differs(result, found, home):
        verdict, other = "failed", home
    else:
        beside = np.count_nonzero(found.agree & ~found.agree[home], axis=1)
        rivals = (found.scores < found.scores[home] + margin) | (
            beside >= least_rival(int(np.count_nonzero(found.agree[home])))
        )
        rivals[home] = False
        if rivals.any():
            verdict, other = "ambiguous", int(np.argmax(rivals))
    came_home = ended == home
    levels = tuple(
        BasinLevel(
            float(np.deg2rad(degrees)),
            of_distance * reach,
            int(np.count_nonzero(level_of == k)),
            int(np.count_nonzero(came_home[level_of == k])),
        )
        for k, (degrees, of_distance) in enumerate(zip(_LEVELS_DEG, _LEVELS_OF_DISTANCE, strict=True))
    )
    if verdict == "unique" and levels[0].share < _HARDLY:
        verdict = "failed"
    counts = np.count_nonzero(found.agree, axis=1).tolist()
    places = tuple(
        Place(found.states.pose(k), float(found.scores[k]), counts[k], int(np.count_nonzero(ended == k)))
        for k in range(len(counts))
    )
    return Basin(
        verdict=verdict,
        levels=levels,
        places=places,
        starts=len(ended),
        pose=result.camera_from_scanner,
        agree=agree,
        matches=len(result.matches),
        other=None if other is None else places[other].pose,
        other_agree=0 if other is None else places[other].agree,
    )


def _far(level: BasinLevel) -> str:
    return f"{np.degrees(level.angle_rad):.0f} deg and {length_in_words(level.distance_m)}"
