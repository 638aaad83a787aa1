"""Cross-validation of intrinsics and poses: the model that predicts held-out matches better is preferred.

Picks are assigned to folds, with all matches of a pick in the same fold; each fold is predicted by a fit to the others.
Two cameras are compared by min(s, gate), so that outliers cost both the same.

Source: Stone, Cross-validatory choice and assessment of statistical predictions (1974).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.foundations.arrays import BoolArray, FloatArray, IntArray
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Matches
from ladarreg_core.pose.estimators import bundle
from ladarreg_core.pose.estimators.bundle import Evaluation, States, adjust_ranges
from ladarreg_core.pose.estimators.intrinsics import Descent, IntrinsicsFit, Noise, estimate_intrinsics, predicted_gains
from ladarreg_core.pose.estimators.measurements import Measurements
from ladarreg_core.pose.estimators.unknown_intrinsics import PARAMETERS, Intrinsics, intrinsic
from ladarreg_core.pose.preconditions import MIN_MATCHES

FOLDS = 5
"""Number of folds."""
SCORE_TEST_SIGMA = 3.7
"""Significance of the score test above which intrinsics are estimated at all: 1 in 10,000 by chance."""
MIN_SHIFT_SIGMA = 3.0
"""Smallest change of an estimated intrinsic that is kept, in its standard deviations."""
CLEAR_GAIN_SIGMA = 2.0
"""Smallest gain on held-out matches for which an intrinsic is kept, in standard errors."""

_WIDE = 9.0  # relative to the gate: a wrong camera puts correct matches beyond it
_WORTH_WIDENING = 1.05
_MAX_S = 1e6
_STEPS = 10
_SETTLED_SIGMA = 0.1
_LADDER: dict[Intrinsics, tuple[Intrinsics, ...]] = {
    "fixed": (),
    "focal": ("focal",),
    "focal_k1": ("focal", "focal_k1"),
    "focal_k1_centre": ("focal", "focal_k1", "focal_k1_centre"),
}


@dataclass(frozen=True, slots=True)
class Gain:
    """Decrease of the cost of held-out matches from one model to another."""

    total: float
    """Sum over the matches, in units of s; positive means better."""
    sigma: float
    """Its standard error, over picks."""

    @property
    def clear(self) -> bool:
        """True if the gain is significant."""
        return self.total > CLEAR_GAIN_SIGMA * self.sigma


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """One step up the ladder of intrinsics models."""

    fit: IntrinsicsFit
    """The fit, with the noise of the previous model."""
    gain: Gain | None
    """Gain over the previous model on held-out matches; None if the fit was discarded before."""
    shift_sigma: float
    """Change of the new intrinsic, in standard deviations scaled by the scatter of the residuals."""
    kept: bool
    """True if the fit was kept."""


@dataclass(frozen=True, slots=True, eq=False)
class IntrinsicsChoice:
    """Intrinsics selected by cross-validation."""

    given: Camera
    """The given camera."""
    fit: IntrinsicsFit | None
    """The fit that was kept; None: the camera stays as given."""
    trials: tuple[Trial, ...]
    """The models that were tried, in order; empty if the given camera passed the score test."""

    @property
    def intrinsics(self) -> Intrinsics:
        """The intrinsics that were kept."""
        return "fixed" if self.fit is None else self.fit.intrinsics

    def describe(self) -> tuple[str, ...]:
        """Return the outcome in sentences; empty if the given camera passed the score test."""
        if self.fit is not None:
            return describe_intrinsics(self.fit, self.given)
        if not self.trials:
            return ()
        last = self.trials[-1].fit
        known = last.sigmas["focal_px"] < last.camera.focal_px / 2
        changes = f" ({' and '.join(_estimates(last))})" if known else ""
        why = "held-out matches are predicted no better" if last.determined else "do not determine them"
        return (
            f"The matches suggest other intrinsics{changes}, but {why}; the camera was kept as given. Check the "
            "matches with the largest residuals first; then provide a camera file, or add matches near and far and "
            "across the whole photo.",
        )


def describe_intrinsics(fit: IntrinsicsFit, given: Camera) -> tuple[str, ...]:
    """Return the estimated intrinsics in sentences.

    Args:
        fit: the fit.
        given: the given camera.
    """
    names = {"focal_px": "focal length", "k1": "distortion k1", "cx": "principal point cx", "cy": "principal point cy"}
    sentences = []
    for name, value in fit.values.items():
        unit = "" if name == "k1" else " px"
        before, sigma = intrinsic(given, name), fit.sigmas[name]
        digits = 3 if name == "k1" else 0 if sigma >= 2 else 1
        sentences.append(
            f"The {names[name]} was estimated as {value:.{digits}f} +- {sigma:.{digits}f}{unit} (given: "
            f"{before:.{digits}f}{unit})."
        )
    if sentences and not fit.determined:
        sentences.append(
            "The matches do not determine the focal length; provide a camera file, or add matches near and far."
        )
    return tuple(sentences)


def _estimates(fit: IntrinsicsFit) -> list[str]:
    words = {"focal_px": "focal length", "k1": "k1", "cx": "cx", "cy": "cy"}
    return [
        f"{words[name]} {value:.3f} +- {fit.sigmas[name]:.3f}"
        if name == "k1"
        else f"{words[name]} {value:.0f} +- {fit.sigmas[name]:.0f} px"
        for name, value in fit.values.items()
    ]


def choose_intrinsics(
    matches: Matches,
    camera: Camera,
    pose: Rigid,
    inliers: BoolArray,
    *,
    sigma_px: float,
    sigma_range_m: float,
    gate_chi2: float = 9.21,
    most: Intrinsics = "focal_k1",
    noise: Noise | None = None,
    at: Evaluation | None = None,
    seed: int = 0,
) -> IntrinsicsChoice:
    """Estimate only those intrinsics that the matches require.

    A score test, cheaper than the pose, first detects whether the given intrinsics are wrong at all. Then each step of
    the ladder (focal, k1, centre) is kept only if the prediction of held-out matches improves significantly, the
    intrinsic changed by more than 3 sigma, and the matches determine the focal length to 2 %.

    Args:
        matches: M matches, which may contain outliers.
        camera: the given camera.
        pose: camera_from_scanner, fitted with that camera.
        inliers: (M,) inliers of that pose.
        sigma_px: pixel noise used, px.
        sigma_range_m: range noise used, m.
        gate_chi2: largest cost s of an inlier.
        most: the last step of the ladder.
        noise: estimator of the noise if it is not stated; None: the noise is as given.
        at: all matches at the pose, with that noise, if known.
        seed: random seed of the folds.
    """
    ladder = _LADDER[most]
    model = _Model(camera, pose, inliers, 0)
    if at is not None and not _rejects(
        Descent.at(at, matches, camera, (sigma_px, sigma_range_m)), inliers, ladder, gate_chi2
    ):
        return IntrinsicsChoice(camera, None, ())
    folds = _Folds.of(matches, sigma_px, sigma_range_m, gate_chi2, seed)
    kept: IntrinsicsFit | None = None
    trials: list[Trial] = []
    if at is None and not folds.rejects(model, ladder):
        return IntrinsicsChoice(camera, None, ())
    for step in ladder:
        if kept is not None and not folds.rejects(model, (step,)):
            continue
        fit = folds.fit(model, step)
        tried, shift, gain = _Model.of(fit), _shift_sigma(fit, camera, step), None
        if fit.determined and shift > MIN_SHIFT_SIGMA:
            gain = folds.gain(*(np.minimum(folds.held_out(m), gate_chi2) for m in (model, tried)))
        good = gain is not None and gain.clear
        trials.append(Trial(fit, gain, shift, good))
        if not fit.determined:
            break  # more free intrinsics determine it even less
        if good:
            kept = folds.fit(tried, step, noise) if noise else fit
            model, folds = _Model.of(kept), replace(folds, sigma_px=kept.sigma_px, sigma_range_m=kept.sigma_range_m)
    return IntrinsicsChoice(camera, kept, tuple(trials))


def _shift_sigma(fit: IntrinsicsFit, given: Camera, step: Intrinsics) -> float:
    """Return the largest change among the intrinsics that a step adds, in standard deviations."""
    new = {"focal": ("focal_px",), "focal_k1": ("k1",), "focal_k1_centre": ("cx", "cy")}[step]
    scatter = np.sqrt(max(1.0, fit.chi2_per_dof)) if fit.dof > 0 else np.inf
    return float(max(abs(fit.values[name] - intrinsic(given, name)) / fit.sigmas[name] for name in new) / scatter)


def worse_when_held_out(
    matches: Matches,
    camera: Camera,
    start: Rigid,
    refined: Rigid,
    inliers: BoolArray,
    *,
    sigma_px: float,
    sigma_range_m: float,
    gate_chi2: float = 9.21,
    seed: int = 0,
) -> bool:
    """Return whether poses fitted to the matches predict held-out ones worse than the initial pose does.

    True as well if there are too few matches to hold any out, because then nothing supports the fit.

    Args:
        matches: M matches, which may contain outliers.
        camera: intrinsics.
        start: the initial camera_from_scanner, obtained without these matches.
        refined: camera_from_scanner, fitted to the matches.
        inliers: (M,) inliers of the refined pose.
        sigma_px: pixel noise, px.
        sigma_range_m: range noise, m.
        gate_chi2: largest cost s of an inlier.
        seed: random seed of the folds.
    """
    folds = _Folds.of(matches, sigma_px, sigma_range_m, gate_chi2, seed)
    measured = folds.measured(camera)
    _, seen = adjust_ranges(measured, States.of([start], measured))
    before, after = _lorentzian(seen.s[0], gate_chi2), folds.held_out(_Model(camera, refined, inliers, 0))
    unknown = np.maximum(before, _lorentzian(np.array(gate_chi2), gate_chi2))
    after = np.where(np.isfinite(after), _lorentzian(after, gate_chi2), unknown)
    return not folds.gain(before, after).total > 0


def _lorentzian(s: FloatArray, gate: float) -> FloatArray:
    """Return a cost that still grows beyond the gate; a truncated one cannot compare poses if the noise is understated.

    Source: Black and Anandan, The robust estimation of multiple motions (1996), the Lorentzian.
    """
    return np.asarray(gate * np.log1p(np.minimum(s, _MAX_S) / gate))


def assign_folds(pick_ids: Sequence[str], *, folds: int = FOLDS, seed: int = 0) -> tuple[IntArray, IntArray]:
    """Assign picks to folds of similar size.

    Args:
        pick_ids: (M,) the pick of each match.
        folds: maximum number of folds; never more than there are picks.
        seed: random seed.

    Returns:
        The index of each match's pick, and its fold, both (M,).
    """
    count = len(set(pick_ids))
    if count == len(pick_ids):
        group = np.arange(count)
    else:
        number: dict[str, int] = {}
        group = np.array([number.setdefault(name, len(number)) for name in pick_ids], dtype=np.intp)
    order = np.random.default_rng(seed).permutation(count)
    return group, (order % max(min(folds, count), 1))[group]


def _rejects(descent: Descent, inliers: BoolArray, ladder: Sequence[Intrinsics], gate: float) -> bool:
    """Return whether a score test rejects the intrinsics of a descent in favour of any step of the ladder."""
    if not ladder:
        return False
    counts = [len(PARAMETERS[step]) for step in ladder]
    if max(predicted_gains(descent, inliers, counts)) > SCORE_TEST_SIGMA:
        return True
    wide = descent.residuals.s[0] <= _WIDE * gate
    more = np.count_nonzero(wide) > _WORTH_WIDENING * np.count_nonzero(inliers)
    return bool(more and max(predicted_gains(descent, wide, counts)) > SCORE_TEST_SIGMA)


@dataclass(frozen=True, slots=True, eq=False)
class _Model:
    """A pose and camera under test."""

    camera: Camera
    pose: Rigid
    inliers: BoolArray
    count: int
    """Number of free intrinsics among (log f, k1, cx, cy)."""

    @staticmethod
    def of(fit: IntrinsicsFit) -> _Model:
        return _Model(fit.camera, fit.pose, fit.inliers, len(PARAMETERS[fit.intrinsics]))


@dataclass(frozen=True, slots=True, eq=False)
class _Folds:
    """All matches, assigned to folds."""

    matches: Matches
    sigma_px: float
    sigma_range_m: float
    gate: float
    group: IntArray
    fold: IntArray

    @staticmethod
    def of(matches: Matches, sigma_px: float, sigma_range_m: float, gate: float, seed: int) -> _Folds:
        return _Folds(matches, sigma_px, sigma_range_m, gate, *assign_folds(matches.pick_ids, seed=seed))

    def measured(self, camera: Camera) -> Measurements:
        return Measurements.of(self.matches, camera, sigma_px=self.sigma_px, sigma_range_m=self.sigma_range_m)

    def fit(self, model: _Model, step: Intrinsics, noise: Noise | None = None) -> IntrinsicsFit:
        return estimate_intrinsics(
            self.matches, model.camera, model.pose, step,
            sigma_px=self.sigma_px, sigma_range_m=self.sigma_range_m, gate_chi2=self.gate, noise=noise,
        )  # fmt: skip

    def descent(self, model: _Model) -> Descent:
        return Descent.start(
            self.matches, model.camera, model.pose, model.count,
            sigma_px=self.sigma_px, sigma_range_m=self.sigma_range_m,
        )  # fmt: skip

    def rejects(self, model: _Model, ladder: Sequence[Intrinsics]) -> bool:
        """Return whether a score test rejects the model in favour of any step of the ladder."""
        return _rejects(self.descent(model), model.inliers, ladder, self.gate)

    def gain(self, before: FloatArray, after: FloatArray) -> Gain:
        by_pick = np.bincount(self.group, before - after)
        n = len(by_pick)
        return Gain(float(by_pick.sum()), float(by_pick.std(ddof=1) * np.sqrt(n)) if n > 1 else float("inf"))

    def held_out(self, model: _Model) -> FloatArray:
        """Return s (M,) of every match under the fit to the inliers of the other folds.

        It is infinite if those are too few for a fit: an underdetermined fit would still depend on the held-out matches
        through its starting pose.
        """
        folds = np.arange(self.fold.max() + 1)
        training = model.inliers & (self.fold != folds[:, None])  # (B, M)
        enough = training @ self.matches.dimensions > 6 + model.count
        enough &= np.count_nonzero(training, axis=1) >= MIN_MATCHES
        s = self._free(model, training) if model.count else self._fixed(model, training)
        own = s[self.fold, np.arange(len(self.matches))]
        return np.where(enough[self.fold], own, np.inf)

    def _fixed(self, model: _Model, training: BoolArray) -> FloatArray:
        """Return s (B, M) under the poses fitted to each training set (B, M)."""
        measured = self.measured(model.camera)
        counts = training.astype(np.float64)
        descent = bundle.Descent.start(measured, States.of([model.pose] * len(training), measured))
        for _ in range(_STEPS):
            descent.step(lambda s: (counts, (s * counts).sum(axis=1)))
            if (descent.step_sigma < _SETTLED_SIGMA).all():
                break
        return adjust_ranges(measured, descent.states)[1].s

    def _free(self, model: _Model, training: BoolArray) -> FloatArray:
        """Return s (B, M) under the poses and cameras fitted to each training set (B, M)."""
        found = []
        start = self.descent(model)
        for members in training:
            descent = replace(start)
            descent.least_squares(members, steps=_STEPS, tolerance_sigma=_SETTLED_SIGMA)
            found.append(adjust_ranges(descent.measured, descent.state)[1].s[0])
        return np.stack(found)
