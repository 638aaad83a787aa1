"""The thesis's nonlinear estimation: minimise Ez with a simplex, remove outliers by depth error, and solve again.

    start -> nelder_mead over all matches -> depth errors -> matches within the threshold -> nelder_mead -> ...

`residual="stereo"` minimises Ez itself (Eq 2.21), `"epipolar"` the same geometry in image units. Ez has poles where a
disparity vanishes and a valley of finite cost at T = 0, so its result depends on the starting pose. A doubtful result
is repeated from the minimum of the epipolar residual, which has neither poles nor valley.

Source: thesis 2.4.2.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from typing import Any, Literal, TypeVar, get_args

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.errors import DegenerateGeometryError, OptionError
from ladarreg_core.foundations.arrays import BoolArray, FloatArray
from ladarreg_core.foundations.validation import LARGEST_INT, require_choice, require_int
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Matches
from ladarreg_core.thesis.estimators.epipolar import epipolar_cost, epipolar_residuals
from ladarreg_core.thesis.estimators.nelder_mead import SimplexStep, nelder_mead, start_simplex
from ladarreg_core.thesis.estimators.starts import StartName, starting_poses
from ladarreg_core.thesis.estimators.stereo import StereoPairs, pose_of, stereo_cost

Residual = Literal["stereo", "epipolar"]
RejectedBy = Literal["depth error", "pixel residual"]
DescentEnd = Literal["settled", "cycle", "round limit", "too few left", "cost below threshold", "stopped by hand"]

MIN_MATCHES = 4
_MIN_KEPT = 6
_MAD = 1.4826
_LEAST, _MOST = 1e-15, 1e6
_NARROW = 0.1  # size of the simplex of later rounds, relative to the first
_DOUBT_OF_DEPTH = 0.05  # relative error of stereo depths beyond which the result is doubtful
_DOUBT_SIGMA, _DOUBT_OF_FOCAL = 10.0, 0.01
_VALLEY = 0.5  # of 2 sum(w Zl^2), the cost at T = 0; good minima lie below .005
_NEVER_BELOW_OF_RANGE, _NEVER_BELOW_PX = 1e-9, 1e-6
_MEANINGFUL_DISPARITY_SIGMA = 40.0

_T = TypeVar("_T")


def _positive(value: Any) -> bool:
    try:
        return not isinstance(value, bool | str) and 0 < float(value) < np.inf
    except (TypeError, ValueError):
        return False


@dataclass(frozen=True, slots=True, kw_only=True)
class SimplexOptions:
    """Options of the simplex and its outlier rejection."""

    residual: Residual = "stereo"
    """`stereo` (Eq 2.21, m) or `epipolar` (the same geometry without poles, image units)."""
    step_m: float | None = None
    """Size of the initial simplex along Tx, Ty, Tz, m; None: a tenth of the median depth."""
    step_rad: float = 0.1
    """Size of the initial simplex along alpha, beta, gamma, rad."""
    tolerance: float = 1e-7
    """A descent stops when the simplex is no larger than this: rad, and m at a median depth of 1 m or more."""
    most_iterations: int = 1500
    """Maximum number of iterations of one descent."""
    most_evaluations: int = 4000
    """Maximum number of cost evaluations of one descent."""
    restarts: int = 2
    """Maximum number of further starting poses after a doubtful descent; 0: the thesis's single descent."""
    stop_cost: float | None = None
    """A descent stops when its cost falls below this: m^2 for `stereo`, image units^2 for `epipolar`; None: never."""
    reject_depth_m: float | None = None
    """Largest depth error sqrt((Zl - Zxs)^2 + (Zl - Zys)^2) of an inlier, m; None: estimated from the data."""
    reject_sigma: float = 2.5
    """Threshold estimated from the data: in robust standard deviations, 1.4826 times the median error."""
    reject_rounds: int = 12
    """Maximum number of rejections, each followed by a descent; 0: all matches count."""

    def __post_init__(self) -> None:
        require_choice(self.residual, get_args(Residual), "the residual")
        for name in ("step_m", "step_rad", "tolerance", "stop_cost", "reject_depth_m", "reject_sigma"):
            value = getattr(self, name)
            may_be_none = name in ("step_m", "stop_cost", "reject_depth_m")
            if not ((value is None and may_be_none) or (_positive(value) and _LEAST <= value <= _MOST)):
                raise OptionError(f"{name} is {value!r}; it must be a positive number ({_LEAST:g} to {_MOST:g})")
        for name, least in (("most_iterations", 1), ("most_evaluations", 1), ("restarts", 0), ("reject_rounds", 0)):
            value = getattr(self, name)
            require_int(value, f"{name}", least=least, most=LARGEST_INT)


DEFAULT_SIMPLEX = SimplexOptions()


@dataclass(frozen=True, slots=True, eq=False)
class DescentStep:
    """One step of the simplex, with its context."""

    simplex: SimplexStep
    """Vertices (Tx, Ty, Tz, alpha, beta, gamma in m and rad), costs, and the move."""
    round: int
    """Number of rejections so far."""
    restart: int
    """Number of restarts so far."""
    residual: Residual
    """The residual that is minimised."""
    inliers: BoolArray
    """(M,) the matches that count."""
    frame_from_scanner: FloatArray
    """(3, 3) rotation to the axes of the parameters."""

    @property
    def camera_from_scanner(self) -> Rigid:
        """Pose of the best vertex."""
        return pose_of(self.simplex.best, self.frame_from_scanner)


@dataclass(frozen=True, slots=True, eq=False)
class SimplexPose:
    """Result of a descent."""

    camera_from_scanner: Rigid
    """The pose."""
    inliers: BoolArray
    """(M,) the matches that counted."""
    cost: float
    """The minimum of the cost, m^2 (`stereo`) or image units^2 (`epipolar`)."""


@dataclass(frozen=True, slots=True, eq=False)
class SimplexFit:
    """The poses before and after outlier rejection, with details of the search."""

    before: SimplexPose
    """From all usable matches."""
    after: SimplexPose
    """From the inliers."""
    residual: Residual
    """The residual that was minimised."""
    start: StartName
    """The starting pose of this result: `given`, `linear`, or `aimed` (a camera slightly to the left)."""
    rejected_by: RejectedBy
    """The error that was compared with the threshold."""
    threshold: float
    """The last threshold, m or px; infinite if none was applied."""
    rounds: int
    """Number of rejections that were followed by a descent."""
    restarts: int
    """Number of restarts."""
    iterations: int
    """Iterations of all descents."""
    evaluations: int
    """Cost evaluations of all descents."""
    stopped: DescentEnd
    """The reason for stopping."""
    collapsed: bool
    """True if the minimum is the valley at T = 0, where the cost is finite but the pose meaningless."""

    def diagnostics(self) -> dict[str, Any]:
        """Return the details of the search for the diagnostics of a result, JSON-ready."""
        return {
            "residual": self.residual,
            "start": self.start,
            "rounds": self.rounds,
            "restarts": self.restarts,
            "iterations": self.iterations,
            "evaluations": self.evaluations,
            "rejected_by": self.rejected_by,
            "reject_threshold": self.threshold if np.isfinite(self.threshold) else None,
            "collapsed": self.collapsed,
            "stopped": self.stopped,
            "before_rejection": self.before.camera_from_scanner.matrix.tolist(),
        }

    def describe(self) -> str:
        """Return the outcome in one sentence."""
        if self.collapsed:
            return (
                "the solution collapsed to the scanner's position, where the stereo cost is finite but meaningless; "
                "start from a closer pose, use 'epipolar_simplex' or 'robust', or increase the baseline"
            )
        kept, all_of_them = int(self.after.inliers.sum()), len(self.after.inliers)
        if not np.isfinite(self.threshold):
            return f"{kept} of {all_of_them} matches used, no outlier rejection, {self.iterations} iterations"
        unit = "m" if self.rejected_by == "depth error" else "px"
        return (
            f"{kept} of {all_of_them} inliers by {self.rejected_by} (threshold {self.threshold:.3g} {unit}), "
            f"{self.rounds} rounds, {self.iterations} iterations"
        )


def stopped_at(step: DescentStep) -> SimplexFit:
    """Return the best pose of a fit that was stopped at a step, without a test for collapse."""
    end = SimplexPose(step.camera_from_scanner, step.inliers, step.simplex.cost)
    return SimplexFit(
        before=end,
        after=end,
        residual=step.residual,
        start="given",
        rejected_by="depth error",
        threshold=np.inf,
        rounds=step.round,
        restarts=step.restart,
        iterations=step.simplex.iteration,
        evaluations=step.simplex.evaluations,
        stopped="stopped by hand",
        collapsed=False,
    )


def fit_simplex(
    matches: Matches,
    camera: Camera,
    options: SimplexOptions | None = None,
    *,
    initial: Rigid | None = None,
    sigma_px: float = 1.0,
) -> SimplexFit:
    """Return the poses before and after outlier rejection; `descend` yields the individual steps."""
    return _return_value(descend(matches, camera, options, initial=initial, sigma_px=sigma_px))


def descend(
    matches: Matches,
    camera: Camera,
    options: SimplexOptions | None = None,
    *,
    initial: Rigid | None = None,
    sigma_px: float = 1.0,
) -> Generator[DescentStep, None, SimplexFit]:
    """Alternate between simplex descents and outlier rejection until the inliers are stable.

    Args:
        matches: M matches; weights multiply squared residuals.
        camera: the photo's camera.
        options: options of the simplex; None: the defaults.
        initial: camera_from_scanner to start from; None: the linear pose, or a camera aimed at the matches if there is
            no linear pose or it is worse.
        sigma_px: pixel noise, by which a baseline is recognised as too small.

    Yields:
        Every step of every descent.

    Returns:
        The fit.

    Raises:
        DegenerateGeometryError: if fewer than 4 matches lie in front of the scanner and within the field of the lens.
        OptionError: if `sigma_px` is not a positive number.

    Source: thesis 2.4.2, Eq 2.21.
    """
    if not _positive(sigma_px):
        raise OptionError(f"sigma_px is {sigma_px!r}; it must be a positive number of pixels")
    pairs = StereoPairs.of(matches, camera)
    usable = int(np.count_nonzero(pairs.usable))
    if usable < MIN_MATCHES:
        raise DegenerateGeometryError(
            f"only {usable} of {len(matches)} matches lie in front of the scanner and within the field of the lens, "
            f"and a pose needs {MIN_MATCHES}; add matches"
        )
    fitter = _Fitter(pairs, options or SimplexOptions(), camera.focal_px, float(sigma_px))
    return fitter.run(starting_poses(matches, pairs, initial))


@dataclass(frozen=True, slots=True, eq=False)
class _Minimum:
    """Minimum of a descent, with or without outlier rejection."""

    x: FloatArray
    keep: BoolArray
    cost: float
    stopped: DescentEnd = "settled"
    threshold: float = np.inf
    rounds: int = 0


_Steps = Generator[DescentStep, None, _T]


@dataclass(slots=True, eq=False)
class _Fitter:
    """All descents of one fit."""

    pairs: StereoPairs
    options: SimplexOptions
    focal_px: float
    sigma_px: float
    round: int = 0
    restart: int = 0
    iterations: int = 0
    evaluations: int = 0

    @property
    def reach_m(self) -> float:
        return float(np.median(self.pairs.depth[self.pairs.usable]))

    def run(self, starts: list[tuple[StartName, FloatArray]]) -> _Steps[SimplexFit]:
        """Descend from the first starting pose, restart while the result is doubtful, and reject outliers."""
        residual, everything = self.options.residual, self.pairs.usable
        name, x = starts[0]
        others = starts[1:]
        if residual == "stereo" and name == "aimed":  # too inaccurate for Ez, whose valley is near
            best = yield from self.via_epipolar(x)
            self.round = 0
            before = yield from self.descent(best.x, everything, residual, narrow=True)
            best = min(best, before, key=self.rank)
        else:
            before = best = yield from self.descent(x, everything, residual)
            if residual == "stereo":
                others = starts  # the epipolar residual may succeed from a start where Ez itself failed
        while self.restart < self.options.restarts and others and self.doubtful(best, residual):
            self.restart += 1
            (other_name, x), others = others[0], others[1:]
            end = yield from (self.via_epipolar(x) if residual == "stereo" else self.descent(x, everything, residual))
            self.round = 0
            if self.rank(end) < self.rank(best):
                best, name = end, other_name
        if best is not before:
            again = yield from self.descent(best.x, everything, residual, narrow=True)
            if again.cost < before.cost or self.collapsed(before, residual):
                before = again
        after = yield from self.reject_outliers(best, residual)
        return SimplexFit(
            before=self.simplex_pose(before),
            after=self.simplex_pose(after),
            residual=residual,
            start=name,
            rejected_by=self.rejected_by(after.x, residual),
            threshold=after.threshold,
            rounds=after.rounds,
            restarts=self.restart,
            iterations=self.iterations,
            evaluations=self.evaluations,
            stopped=after.stopped,
            collapsed=self.collapsed(after, residual),
        )

    def via_epipolar(self, x: FloatArray) -> _Steps[_Minimum]:
        """Minimise the epipolar residual first and reject outliers; then minimise Ez without matches near a pole."""
        end = yield from self.descent(x, self.pairs.usable, "epipolar")
        end = yield from self.reject_outliers(end, "epipolar")
        return (yield from self.reject_outliers(end, "stereo"))

    def rank(self, end: _Minimum) -> tuple[bool, float]:
        """Return the sort key of minima, the best first."""
        return self.collapsed(end, self.options.residual), self.median_error(end, self.options.residual)

    def simplex_pose(self, end: _Minimum) -> SimplexPose:
        return SimplexPose(self.pairs.pose(end.x), _read_only(end.keep), end.cost)

    def descent(self, x: FloatArray, keep: BoolArray, residual: Residual, *, narrow: bool = False) -> _Steps[_Minimum]:
        """Minimise the cost of the matches kept."""
        o, chosen, reach, keep = self.options, self.pairs.subset(keep), self.reach_m, _read_only(keep)
        share = _NARROW if narrow else 1.0
        side_m = (o.step_m if o.step_m is not None else 0.1 * reach) * share
        sides = np.maximum([side_m] * 3 + [o.step_rad * share] * 3, 1e-6 * np.abs(x))
        w = chosen.weights
        total = 1e-12 * float(w @ chosen.depth**2) if residual == "stereo" else 1e-14 * float(w.sum())
        steps = nelder_mead(
            stereo_cost(chosen) if residual == "stereo" else epipolar_cost(chosen),
            start_simplex(x, sides),
            x_tolerance=o.tolerance * min(1.0, reach),
            cost_tolerance=total * (o.tolerance / 1e-7) ** 2,
            most_iterations=o.most_iterations,
            most_evaluations=o.most_evaluations,
        )
        goal = o.stop_cost if o.stop_cost is not None and residual == o.residual else -np.inf
        while True:
            with np.errstate(all="ignore"):  # poles are expected
                step = next(steps, None)
            if step is None:
                break
            last = step
            yield DescentStep(step, self.round, self.restart, residual, keep, self.pairs.frame_from_scanner)
            if step.cost <= goal:
                break
        self.iterations += last.iteration
        self.evaluations += last.evaluations
        return _Minimum(last.best, keep, last.cost, "cost below threshold" if last.cost <= goal else "settled")

    def reject_outliers(self, end: _Minimum, residual: Residual) -> _Steps[_Minimum]:
        """Alternate between selecting matches within the threshold and descending, until the selection is stable."""
        x, keep, cost, threshold = end.x, end.keep, end.cost, np.inf
        known: set[bytes] = set()
        stopped: DescentEnd = "round limit"
        rounds = 0
        halving = True
        while rounds < self.options.reject_rounds:
            errors = self.errors(x, residual)
            threshold = self.threshold(errors, x, residual)
            within = errors <= threshold
            halving = halving and self.rejected_by(x, residual) == "pixel residual"
            if (within == keep).all() and not (halving and self.doubtful(_Minimum(x, keep, cost), residual)):
                stopped = "settled"
                break
            if halving:
                # many outliers bias the first pose; keeping the better half removes them step by step
                better = errors <= np.median(errors[self.pairs.usable])
                halving = better.tobytes() not in known and rounds < self.options.reject_rounds // 2
                within = better if halving else within
            if np.count_nonzero(within) < min(_MIN_KEPT, int(np.count_nonzero(self.pairs.usable))):
                stopped = "too few left"
                break
            if within.tobytes() in known:
                stopped = "cycle"
                break
            rounds += 1
            self.round = end.rounds + rounds
            keep = within
            known.add(keep.tobytes())
            there = yield from self.descent(x, keep, residual, narrow=True)
            x, cost = there.x, there.cost
            if there.stopped == "cost below threshold":
                stopped = there.stopped
                break
        return _Minimum(x, keep, cost, stopped, float(threshold), end.rounds + rounds)

    def rejected_by(self, x: FloatArray, residual: Residual) -> RejectedBy:
        """Return the error that identifies outliers: depth error, or pixels if the baseline is too small for depths."""
        if residual == "stereo":
            return "depth error"
        if self.options.reject_depth_m is None or self.options.residual == "stereo":
            return "pixel residual"
        disparity = np.hypot(x[0], x[1]) / self.reach_m * self.focal_px
        # depths are meaningless at a small baseline
        return "depth error" if disparity >= _MEANINGFUL_DISPARITY_SIGMA * self.sigma_px else "pixel residual"

    def errors(self, x: FloatArray, residual: Residual) -> FloatArray:
        """Return the error (M,) of each match, m or px; infinite if undefined."""
        return self.pairs.depth_errors(x) if self.rejected_by(x, residual) == "depth error" else self.pixel_errors(x)

    def pixel_errors(self, x: FloatArray) -> FloatArray:
        """Return the length (M,) of the epipolar residual, px; infinite if undefined."""
        pixels = np.linalg.norm(epipolar_residuals(x, self.pairs), axis=0) * self.focal_px
        return np.where(self.pairs.usable & np.isfinite(pixels), pixels, np.inf)

    def threshold(self, errors: FloatArray, x: FloatArray, residual: Residual) -> float:
        by_depth = self.rejected_by(x, residual) == "depth error"
        if by_depth and self.options.reject_depth_m is not None:
            return float(self.options.reject_depth_m)
        # do not reject exact matches for rounding errors
        least = _NEVER_BELOW_OF_RANGE * self.reach_m if by_depth else _NEVER_BELOW_PX
        return max(self.options.reject_sigma * _MAD * float(np.median(errors[self.pairs.usable])), least)

    def median_error(self, end: _Minimum, residual: Residual) -> float:
        """Return the median error of all usable matches, relative to depth (`stereo`) or in px; robust to poles."""
        if residual == "stereo":
            relative = self.pairs.depth_errors(end.x)[self.pairs.usable] / self.pairs.depth[self.pairs.usable]
            return float(np.median(relative) / np.sqrt(2))
        return float(np.median(self.pixel_errors(end.x)[self.pairs.usable]))

    def doubtful(self, end: _Minimum, residual: Residual) -> bool:
        if self.collapsed(end, residual):
            return True
        most = max(_DOUBT_SIGMA * self.sigma_px, _DOUBT_OF_FOCAL * self.focal_px)
        return not self.median_error(end, residual) <= (_DOUBT_OF_DEPTH if residual == "stereo" else most)

    def collapsed(self, end: _Minimum, residual: Residual) -> bool:
        """Return whether the baseline is within pixel noise, or the cost that of a zero baseline."""
        if residual == "epipolar":
            return False
        kept = self.pairs.subset(end.keep)
        valley = 2 * float(kept.weights @ kept.depth**2)
        within_noise = np.hypot(end.x[0], end.x[1]) * self.focal_px < self.sigma_px * self.reach_m
        return bool(within_noise or not end.cost < _VALLEY * valley)


def _return_value(steps: Generator[Any, None, _T]) -> _T:
    while True:
        try:
            next(steps)
        except StopIteration as end:
            value: _T = end.value
            return value


def _read_only(mask: BoolArray) -> BoolArray:
    mask = mask.copy()
    mask.flags.writeable = False
    return mask
