"""`register_targets`: where scanners stood, by survey targets in their scans."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.errors import DegenerateGeometryError, OptionError
from ladarreg_core.foundations.arrays import read_only
from ladarreg_core.foundations.validation import require_number
from ladarreg_core.frames import Rigid, skew
from ladarreg_core.registration.stations.survey_target import SurveyTarget
from ladarreg_core.registration.stations.target_levels import Levels, information_root
from ladarreg_core.registration.stations.target_matching import LEAST
from ladarreg_core.registration.stations.target_network import Body, NotConnectedError, fit_network

_MIN_VARIANCE = 1e-14  # m^2, so that coordinates without a deviation have a weight
_NO_COORDINATES: Mapping[str, Any] = MappingProxyType({})


@dataclass(frozen=True, slots=True, eq=False)
class TargetRegistration:
    """The pose of a scanner by its targets, and how well they agree."""

    world_from_scanner: Rigid
    """The pose, in the frame of the coordinates."""
    covariance: NDArray[np.float64]
    """(6, 6) of (w, c): R_true = exp([w]x) R, c = C_true - C; w in rad, C the scanner's centre, m, both in the frame
    of the coordinates."""
    residuals_m: dict[str, NDArray[np.float64]]
    """(3,) of each target that has coordinates: these less where the scan puts it, in their frame, m."""
    left_out: tuple[str, ...]
    """Targets that contradict all others: moved or misnamed. The pose does not rest on them."""
    chi2: float
    """Sum of the squared residuals of the targets used, by their covariances."""
    dof: int
    """Degrees of freedom: 3 n - 6."""

    @property
    def sigmas(self) -> tuple[float, float]:
        """Standard deviations of position, m, and direction, rad, over all axes."""
        variances = np.diag(self.covariance)
        return float(np.sqrt(variances[3:].sum())), float(np.sqrt(variances[:3].sum()))

    def as_fields(self) -> dict[str, Any]:
        """Return the statement of the registration as plain values, for a JSON file."""
        return {
            "world_from_scanner": self.world_from_scanner.matrix.tolist(),
            "covariance": self.covariance.tolist(),
            "chi2": self.chi2,
            "dof": self.dof,
            "targets": [
                {"name": name, "residual_m": value.tolist(), "used": name not in self.left_out}
                for name, value in self.residuals_m.items()
            ],
        }


@dataclass(frozen=True, slots=True, eq=False)
class TargetNetwork:
    """The poses of several scanners by the targets that their scans share, and how well these agree."""

    world_from_scanner: dict[str, Rigid]
    """The pose of each scanner, by the name of its scan."""
    covariance: NDArray[np.float64]
    """(6 S, 6 S) of (w, c) of all, in this order, as of `TargetRegistration`; zero for the scan whose frame is the
    world."""
    in_coordinates: bool
    """Whether the world is that of the surveyed coordinates; else it is the frame of the first scan."""
    places: dict[str, NDArray[np.float64]]
    """(3,) of each target that is known more than once, in the world, m."""
    residuals_m: dict[str, dict[str, NDArray[np.float64]]]
    """(3,) of each of these in each scan: the target's place less where the scan puts it, in the world, m."""
    coordinate_residuals_m: dict[str, NDArray[np.float64]]
    """(3,) surveyed coordinates less the target's place, m; empty if the world is not theirs."""
    left_out: tuple[tuple[str | None, str], ...]
    """Scan and target of each observation that contradicts the others, None in place of a scan for surveyed
    coordinates; of only two that contradict each other, both. Nothing rests on them."""
    chi2: float
    """Sum of the squared residuals of the observations used, by their covariances."""
    dof: int
    """Its degrees of freedom."""
    reasons: tuple[str, ...]
    """Remarks, such as why the world is not that of the coordinates."""

    def covariance_of(self, scan: str) -> NDArray[np.float64]:
        """Return the (6, 6) of the (w, c) of one scanner."""
        at = 6 * list(self.world_from_scanner).index(scan)
        return self.covariance[at : at + 6, at : at + 6]

    def between(self, first: str, second: str) -> tuple[Rigid, NDArray[np.float64]]:
        """Return `first_from_second` of two scans, and its covariance (6, 6) of (w, c) in the frame of the first."""
        names = list(self.world_from_scanner)
        one, other = self.world_from_scanner[first], self.world_from_scanner[second]
        arm = other.translation - one.translation
        by_first, by_second = -np.eye(6), np.eye(6)
        by_first[3:, :3] = skew(arm)
        rows = [6 * names.index(first) + np.arange(6), 6 * names.index(second) + np.arange(6)]
        joint = self.covariance[np.ix_(np.concatenate(rows), np.concatenate(rows))]
        step = np.kron(np.eye(2), one.rotation.T) @ np.hstack([by_first, by_second])
        return one.inverse @ other, np.asarray(step @ joint @ step.T)

    def as_fields(self) -> dict[str, Any]:
        """Return the statement of the registration as plain values, for a JSON file."""
        return {
            "world_is": "of the surveyed coordinates" if self.in_coordinates else "the frame of the first scan",
            "reasons": list(self.reasons), "chi2": self.chi2, "dof": self.dof,
            "scans": [
                {
                    "scan": scan, "world_from_scanner": pose.matrix.tolist(),
                    "covariance": self.covariance_of(scan).tolist(),
                    "targets": [
                        {"name": name, "residual_m": off.tolist(), "used": (scan, name) not in self.left_out}
                        for name, off in self.residuals_m[scan].items()
                    ],
                }
                for scan, pose in self.world_from_scanner.items()
            ],
            "covariance": self.covariance.tolist(),
            "targets": [{"name": name, "place_m": place.tolist()} for name, place in self.places.items()],
            "coordinates": [
                {"name": name, "residual_m": off.tolist(), "used": (None, name) not in self.left_out}
                for name, off in self.coordinate_residuals_m.items()
            ],
        }  # fmt: skip


@overload
def register_targets(
    targets: Mapping[str, SurveyTarget], coordinates: Mapping[str, SurveyTarget | ArrayLike], *, sigma_m: float = ...
) -> TargetRegistration: ...
@overload
def register_targets(
    targets: Mapping[str, Mapping[str, SurveyTarget]], coordinates: Mapping[str, ArrayLike] = ..., *,
    sigma_m: float = ..., levels: Mapping[str, float | ArrayLike] = ...,
) -> TargetNetwork: ...  # fmt: skip
def register_targets(
    targets: Mapping[str, SurveyTarget] | Mapping[str, Mapping[str, SurveyTarget]],
    coordinates: Mapping[str, Any] = _NO_COORDINATES,
    *,
    sigma_m: float = 0.001,
    levels: Mapping[str, float | ArrayLike] = _NO_COORDINATES,
) -> TargetRegistration | TargetNetwork:
    """Find where scanners stood from targets in their scans that are known elsewhere, or that several scans share.

    Targets of one name are one target; those that are known once only are ignored. What contradicts all others, such as
    a target that was moved or two with exchanged names, is left out, where what remains determines which.

    Args:
        targets: the targets in a scan, by name; or those of several scans, by the names of these.
        coordinates: where they are: (3,) surveyed coordinates, m, or, for a single scan, the `SurveyTarget` of another
            scan, whose scanner's frame is then the world. Several scans need none; if three or more, not on a line, are
            given of targets in any of the scans, the world is theirs.
        sigma_m: standard deviation of each surveyed coordinate, m.
        levels: how level scans are, of several: by the name of one whose Z axis an inclinometer has made up, standard
            deviation of that about each horizontal axis, deg, or its covariance (3, 3), as `level_covariance` of
            `panorama.json`. Up is the Z axis of the coordinates if the world is theirs; else it is estimated.

    Returns:
        the pose with its covariance, and the residual of each target; the same of all scans for several.

    Raises:
        OptionError: if coordinates are not three finite numbers, `sigma_m` is negative, or a level is of no scan.
        DegenerateGeometryError: if fewer than three targets are common to scans, or to a scan and the coordinates, they
            lie on a line, or they contradict each other and it cannot be decided which is wrong.
    """
    require_number(sigma_m, "sigma_m", least=0.0)
    scans = {name: value for name, value in targets.items() if not isinstance(value, SurveyTarget)}
    if scans and len(scans) < len(targets):
        raise OptionError("some targets are given by scan, and others are not; give one or the other for all")
    unknown = [name for name in levels if name not in scans]
    if unknown:
        raise OptionError(
            f"the level of {unknown[0]!r} is given, which is none of several scans; give the targets by scan, and "
            "levels by their names"
        )
    if scans:
        return _register_scans(scans, coordinates, sigma_m, levels)
    single = {name: value for name, value in targets.items() if isinstance(value, SurveyTarget)}
    names = [name for name in single if name in coordinates]
    if len(names) < LEAST:
        raise DegenerateGeometryError(
            f"{len(names)} of {len(targets)} targets in the scan have coordinates under the same name; at least "
            f"{LEAST} are needed: name them alike, or find more"
        )
    known = _body("the coordinates", {name: known_place(name, coordinates[name], sigma_m) for name in names})
    own = _body("the scan", {name: (single[name].center, single[name].covariance) for name in names})
    found = fit_network([known, own])
    pose = found.poses[1]
    out = {name for _, name in found.left_out}
    return TargetRegistration(
        pose, found.covariance[6:, 6:], {name: known.centers[name] - pose @ own.centers[name] for name in names},
        tuple(name for name in names if name in out), found.chi2, found.dof,
    )  # fmt: skip


def _register_scans(
    scans: Mapping[str, Mapping[str, SurveyTarget]], coordinates: Mapping[str, ArrayLike], sigma_m: float,
    levels: Mapping[str, float | ArrayLike],
) -> TargetNetwork:  # fmt: skip
    if any(isinstance(value, SurveyTarget) for value in coordinates.values()):
        raise OptionError("the coordinates of targets in several scans are three numbers; give other scans as scans")
    bodies = [
        _body(f"scan {scan}", {name: (one.center, one.covariance) for name, one in own.items()})
        for scan, own in scans.items()
    ]
    everything = {name: known_place(name, value, sigma_m) for name, value in coordinates.items()}
    seen = {name for own in scans.values() for name in own}
    surveyed = _body("the coordinates", {name: place for name, place in everything.items() if name in seen})
    reasons: tuple[str, ...] = ()
    names, index = list(scans), {scan: k for k, scan in enumerate(scans)}
    roots = {index[scan]: information_root(scan, value) for scan, value in levels.items()}
    own_levels = Levels(roots, is_known=False) if roots else None
    in_coordinates = bool(surveyed.centers)
    try:
        if in_coordinates:
            found = fit_network([*bodies, surveyed], len(bodies), Levels(roots, is_known=True) if roots else None)
        else:
            found = fit_network(bodies, levels=own_levels)
    except NotConnectedError:
        if not in_coordinates or len(bodies) == 1:
            raise
        found, in_coordinates = fit_network(bodies, levels=own_levels), False
        count = len(surveyed.centers)
        reasons = (
            f"The world is the frame of the first scan: of {count} target{'' if count == 1 else 's'} in the scans "
            "surveyed coordinates are known, and at least three, not on a line, are needed.",
        )
    reasons += tuple(
        f"The level of scan {names[k]} contradicts the targets and is not used: its inclinometer is wrong, or the scan "
        "is not level."
        for k in found.levels_left_out
    )
    residuals = {
        scan: {name: found.places[name] - found.poses[index[scan]] @ one.center
               for name, one in own.items() if name in found.places}
        for scan, own in scans.items()
    }  # fmt: skip
    return TargetNetwork(
        dict(zip(names, found.poses, strict=False)), found.covariance[: 6 * len(names), : 6 * len(names)],
        in_coordinates, found.places, residuals,
        {name: place - found.places[name] for name, place in surveyed.centers.items()} if in_coordinates else {},
        tuple((names[k] if k < len(names) else None, name) for k, name in found.left_out),
        found.chi2, found.dof, reasons,
    )  # fmt: skip


def _body(name: str, places: Mapping[str, tuple[NDArray[np.float64], NDArray[np.float64]]]) -> Body:
    return Body(
        name, {target: place for target, (place, _) in places.items()},
        {target: covariance + _MIN_VARIANCE * np.eye(3) for target, (_, covariance) in places.items()},
    )  # fmt: skip


def known_place(
    name: str, value: SurveyTarget | ArrayLike, sigma_m: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return where a target is known to be, (3,) m, and its covariance (3, 3); arguments as of `register_targets`."""
    if isinstance(value, SurveyTarget):
        return value.center, value.covariance
    point = read_only(value, np.float64, (3,), f"the coordinates of target {name}")
    if not np.isfinite(point).all():
        raise OptionError(
            f"the coordinates of target {name} are {point.tolist()}; give three finite numbers, in metres"
        )
    return point, sigma_m**2 * np.eye(3)
