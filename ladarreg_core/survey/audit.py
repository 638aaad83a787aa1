"""Is a calibration still right? What the images say of a pose that is used, and how small an error they would show.

The photograph is registered near the pose. Where the images verify a place, the difference (w, c) between both is
compared with the covariance C of that place: d^T C^-1 d is chi squared with 6 degrees of freedom if the pose is right.
An error e of the pose makes it noncentral with e^T C^-1 e, so that the probability of seeing an error follows before
one occurs: the power of the test.

Source: Neyman and Pearson 1933; for networks of measurements Baarda 1968, 'A testing procedure for use in geodetic
networks' (internal reliability).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypedDict

import numpy as np

from ladarreg_core.camera import CameraModel
from ladarreg_core.errors import OptionError
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.foundations.formatting import format_angle, format_length
from ladarreg_core.foundations.validation import require_type
from ladarreg_core.frames import Rigid
from ladarreg_core.photo import Photo
from ladarreg_core.registration.register import RegisterOptions, register
from ladarreg_core.results.registration import Registration
from ladarreg_core.results.steps import StepReport
from ladarreg_core.scan import Scan
from ladarreg_core.survey.least_squares.problem import pose_difference

Outcome = Literal["right", "wrong", "undecidable"]
FALSE_ALARM = 0.05
"""Share of right poses that are called wrong."""
SEEN = 0.9
"""Probability at which an error counts as one that would have been seen."""
_DIRECTIONS = 60
_SMALLEST, _LARGEST = 1e-5, 1.0
_SIZES_RAD = np.radians([0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0])
_SIZES_M = np.array([1, 2, 5, 10, 20, 50, 100, 200]) / 1000


class PowerFields(TypedDict):
    """What an audit would have seen: sizes of errors, each with the probability of seeing it."""

    rotation_rad: list[list[float]]
    position_m: list[list[float]]
    seen_with_probability: float
    smallest_rotation_rad: float | None
    smallest_position_m: float | None


class AuditFields(TypedDict):
    """The fields of an audit, JSON-ready."""

    outcome: Outcome
    sentence: str
    p_value: float | None
    false_alarm: float
    correction: list[float] | None
    covariance: list[list[float]] | None
    camera_from_scanner: list[list[float]] | None
    power: PowerFields


@dataclass(frozen=True, slots=True)
class PowerPoint:
    """The probability of seeing an error of a size, over all its directions."""

    size: float
    """rad or m."""
    probability: float


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Audit:
    """What the images say of a pose that is used."""

    outcome: Outcome
    """`right`: they verify it within their uncertainty; `wrong`: they verify another one that differs significantly;
    `undecidable`: they verify nothing near it."""
    sentence: str
    """The outcome in words."""
    correction: FloatArray
    """(6,) (w, c) that leads from the pose to where the images put the camera, rad and m; NaN if undecidable."""
    covariance: FloatArray
    """(6, 6) of the correction; NaN if undecidable."""
    p_value: float
    """Probability of a difference as large or larger if the pose is right; NaN if undecidable."""
    corrected: Rigid | None
    """`camera_from_scanner` by the images; None if undecidable."""
    rotation_power: tuple[PowerPoint, ...] = ()
    """Probability of seeing rotations of some sizes, rad."""
    position_power: tuple[PowerPoint, ...] = ()
    """Probability of seeing displacements of some sizes, m."""
    smallest_rotation_rad: float = float("nan")
    """Smallest rotation that would be seen with a probability of `SEEN`, over all axes."""
    smallest_position_m: float = float("nan")
    """Smallest displacement, likewise."""

    def as_fields(self) -> AuditFields:
        """Return the result as JSON-ready fields."""
        known = self.corrected is not None

        def curve(points: Sequence[PowerPoint]) -> list[list[float]]:
            return [[one.size, one.probability] for one in points]

        return {
            "outcome": self.outcome,
            "sentence": self.sentence,
            "p_value": self.p_value if known else None,
            "false_alarm": FALSE_ALARM,
            "correction": self.correction.tolist() if known else None,
            "covariance": self.covariance.tolist() if known else None,
            "camera_from_scanner": None if self.corrected is None else self.corrected.matrix.tolist(),
            "power": {
                "rotation_rad": curve(self.rotation_power),
                "position_m": curve(self.position_power),
                "seen_with_probability": SEEN,
                "smallest_rotation_rad": _finite(self.smallest_rotation_rad),
                "smallest_position_m": _finite(self.smallest_position_m),
            },
        }


def audit(
    scan: Scan,
    photo: Photo,
    pose: Rigid,
    *,
    camera: CameraModel | None = None,
    options: RegisterOptions | None = None,
    report: StepReport | None = None,
) -> Audit:
    """Judge a calibration that is used: a pose, and the camera with it.

    Args:
        scan: the scan.
        photo: the photograph.
        pose: `camera_from_scanner` that is used.
        camera: the camera that is used with it; None: that of the photograph.
        options: seed and thresholds of the registration.
        report: receives every finished `Step`; may raise `Cancelled`.

    Raises:
        OptionError: if an argument is of a wrong type, or the camera is not of the photograph's size.
    """
    require_type(scan, Scan, "'scan'")
    require_type(photo, Photo, "'photo'")
    require_type(pose, Rigid, "'pose'")
    o = RegisterOptions() if options is None else require_type(options, RegisterOptions, "'options'")
    if camera is not None:
        if camera.size != photo.camera.size:
            raise OptionError(
                f"the camera is of {camera.width} x {camera.height} px, and the photo has {photo.camera.width} x "
                f"{photo.camera.height}; give the camera of this photo"
            )
        photo = replace(photo, camera=camera, calibrated=True, assumed=False, alternatives=())
    near = replace(o, auto=replace(o.auto, reach="near_start"))
    result = register(scan, photo, initial=pose, options=near, report=report)
    return judged(result, pose)


def judged(result: Registration, pose: Rigid) -> Audit:
    """Return the audit of a pose by a registration near it."""
    if not result.accepted or not np.isfinite(result.covariance).all():
        unknown = np.full(6, np.nan)
        why = result.reasons[0] if result.reasons else "nothing near it agrees."
        return Audit(
            outcome="undecidable", sentence=f"The images verify nothing near this pose: {why[:1].lower()}{why[1:]}",
            correction=unknown, covariance=np.full((6, 6), np.nan), p_value=float("nan"), corrected=None,
        )  # fmt: skip
    found, covariance = result.camera_from_scanner, np.asarray(result.covariance)
    correction = pose_difference(found, pose)
    p_value = probability_of(correction, covariance)
    rotation, position = (_power(covariance, rows, sizes) for rows, sizes in (((0, 3), _SIZES_RAD), ((3, 6), _SIZES_M)))
    smallest = [_smallest_seen(covariance, rows) for rows in ((0, 3), (3, 6))]
    length, angle = float(np.linalg.norm(correction[3:])), float(np.linalg.norm(correction[:3]))
    away = f"{format_length(length)} and {format_angle(angle)}"
    seen = f"{format_length(smallest[1])} or {format_angle(smallest[0])}"
    would = f"An error of {seen} would have been seen nine times in ten."
    wrong = p_value < FALSE_ALARM
    sentence = (
        f"The images put the camera {away} away from this pose, which chance explains with a probability of "
        f"{p_value:.2g}: correct it. {would}"
        if wrong
        else f"The images agree with this pose; what they would change, {away}, is within their uncertainty. {would}"
    )
    return Audit(
        outcome="wrong" if wrong else "right", sentence=sentence, correction=correction, covariance=covariance,
        p_value=p_value, corrected=found, rotation_power=rotation, position_power=position,
        smallest_rotation_rad=smallest[0], smallest_position_m=smallest[1],
    )  # fmt: skip


def probability_of(correction: FloatArray, covariance: FloatArray) -> float:
    """Return the probability of a correction (6,) as large or larger, in standard deviations, if the pose is right."""
    from scipy.stats import chi2

    return float(chi2.sf(correction @ np.linalg.solve(covariance, correction), 6))


def power_of(covariance: FloatArray, error: FloatArray) -> float:
    """Return the probability that an error (6,) of (w, c) is seen, for the covariance (6, 6) of the images' place."""
    from scipy.stats import chi2, ncx2

    limit = chi2.isf(FALSE_ALARM, 6)
    return float(ncx2.sf(limit, 6, max(float(error @ np.linalg.solve(covariance, error)), 1e-12)))


def _power(covariance: FloatArray, rows: tuple[int, int], sizes: FloatArray) -> tuple[PowerPoint, ...]:
    return tuple(PowerPoint(float(size), _mean_power(covariance, rows, float(size))) for size in sizes)


def _mean_power(covariance: FloatArray, rows: tuple[int, int], size: float) -> float:
    """Return the probability of seeing an error of a size, averaged over its directions."""
    from scipy.stats import chi2, ncx2

    part = slice(*rows)
    information = np.linalg.inv(covariance)[part, part]
    directions = _evenly_spread()
    noncentral = size**2 * np.einsum("ni,ij,nj->n", directions, information, directions)
    return float(ncx2.sf(chi2.isf(FALSE_ALARM, 6), 6, np.maximum(noncentral, 1e-12)).mean())


def _smallest_seen(covariance: FloatArray, rows: tuple[int, int]) -> float:
    """Return the size of an error that is seen with the probability `SEEN`, infinite beyond 1 rad or m."""
    low, high = np.log(_SMALLEST), np.log(_LARGEST)
    if _mean_power(covariance, rows, _LARGEST) < SEEN:
        return float("inf")
    for _ in range(18):
        middle = (low + high) / 2
        low, high = (low, middle) if _mean_power(covariance, rows, float(np.exp(middle))) >= SEEN else (middle, high)
    return float(np.exp(high))


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _evenly_spread() -> FloatArray:
    """Return unit vectors (N, 3) spread evenly over all directions. Source: Fibonacci lattice, Gonzalez 2010."""
    k = np.arange(_DIRECTIONS) + 0.5
    z = 1 - 2 * k / _DIRECTIONS
    angle = np.pi * (1 + np.sqrt(5)) * k
    across = np.sqrt(1 - z**2)
    return np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=-1)
