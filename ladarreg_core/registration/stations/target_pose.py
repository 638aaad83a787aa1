"""`register_targets`: where a scanner stood, by its survey targets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.errors import DegenerateGeometryError, OptionError
from ladarreg_core.foundations.arrays import read_only
from ladarreg_core.foundations.validation import require_number
from ladarreg_core.frames import Rigid, rotation_from_rotvec, skew
from ladarreg_core.registration.stations.survey_target import SurveyTarget

_MIN_TARGETS = 3
_MIN_BREADTH = 0.02  # of the targets across their longest extent, as a share of it
_LEVEL = 1e-3  # chance at which targets that fit are taken for ones that do not
_ROUNDS = 20


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


def register_targets(
    targets: Mapping[str, SurveyTarget],
    coordinates: Mapping[str, SurveyTarget | ArrayLike],
    *,
    sigma_m: float = 0.001,
) -> TargetRegistration:
    """Find where a scanner stood from targets in its scan that are known elsewhere.

    Targets of one name are one target; those of only one side are ignored. One target that contradicts all others, or
    two such as exchanged names, is left out, where what remains determines which.

    Args:
        targets: the targets in the scan, by name.
        coordinates: where they are: (3,) surveyed coordinates, m, or the `SurveyTarget` of another scan, whose
            scanner's frame is then the world.
        sigma_m: standard deviation of each surveyed coordinate, m.

    Returns:
        the pose with its covariance, and the residual of each target.

    Raises:
        OptionError: if coordinates are not three finite numbers, or `sigma_m` is negative.
        DegenerateGeometryError: if fewer than three targets are common to both, they lie on a line, or they contradict
            each other and it cannot be decided which is wrong.
    """
    require_number(sigma_m, "sigma_m", least=0.0)
    names = [name for name in targets if name in coordinates]
    if len(names) < _MIN_TARGETS:
        raise DegenerateGeometryError(
            f"{len(names)} of {len(targets)} targets in the scan have coordinates under the same name; at least "
            f"{_MIN_TARGETS} are needed: name them alike, or find more"
        )
    own = np.array([targets[name].center for name in names])
    own_covariance = np.array([targets[name].covariance for name in names])
    known = [known_place(name, coordinates[name], sigma_m) for name in names]
    world, world_covariance = np.array([k[0] for k in known]), np.array([k[1] for k in known])

    def fitted(used: NDArray[np.intp]) -> tuple[Rigid, NDArray[np.float64], float]:
        return _fit(own[used], own_covariance[used], world[used], world_covariance[used])

    everything = np.arange(len(names))
    _check_breadth(own)
    used, (pose, covariance, chi2) = everything, fitted(everything)
    if _chance(chi2, len(used)) < _LEVEL:
        used = _consistent(names, own, fitted)
        pose, covariance, chi2 = fitted(used)
    residuals = world - pose @ own
    return TargetRegistration(
        pose, covariance, dict(zip(names, residuals, strict=True)),
        tuple(names[k] for k in everything if k not in used), chi2, 3 * len(used) - 6,
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


def _check_breadth(points: NDArray[np.float64]) -> None:
    extents = np.linalg.svd(points - points.mean(0), compute_uv=False)
    if extents[1] <= _MIN_BREADTH * extents[0]:
        raise DegenerateGeometryError(
            "the targets lie on a line, about which the scanner could stand anywhere; add a target beside it"
        )


def _consistent(names: list[str], own: NDArray[np.float64], fitted: Any) -> NDArray[np.intp]:
    """Return the indices of the targets that agree when one or two are left out; raise where that is not unique."""
    count = len(names)
    for out in (1, 2):
        # Any three targets nearly agree: two may only be left out where four remain.
        if count - out < _MIN_TARGETS + out - 1:
            break
        agreeing = []
        for left in combinations(range(count), out):
            used = np.setdiff1d(np.arange(count), left)
            extents = np.linalg.svd(own[used] - own[used].mean(0), compute_uv=False)
            if extents[1] > _MIN_BREADTH * extents[0] and _chance(fitted(used)[2], len(used)) >= _LEVEL:
                agreeing.append(used)
        if len(agreeing) == 1:
            return np.asarray(agreeing[0], np.intp)
        if agreeing:
            break
    raise DegenerateGeometryError(
        f"the {count} targets contradict each other, and it cannot be decided which is wrong; check their names and "
        "coordinates, or add targets"
    )


def _chance(chi2: float, count: int) -> float:
    from scipy.special import chdtrc

    return float(chdtrc(3 * count - 6, chi2))


def rigid_motion(own: NDArray[np.float64], world: NDArray[np.float64]) -> Rigid:
    """Return the rigid motion of points (N, 3) onto others by least squares; N is 3 or more.

    Source: Kabsch 1976; Umeyama 1991 for the sign.
    """
    u, _, vt = np.linalg.svd((world - world.mean(0)).T @ (own - own.mean(0)))
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return Rigid(rotation, world.mean(0) - rotation @ own.mean(0))


def _fit(
    own: NDArray[np.float64], own_covariance: NDArray[np.float64], world: NDArray[np.float64],
    world_covariance: NDArray[np.float64],
) -> tuple[Rigid, NDArray[np.float64], float]:  # fmt: skip
    """Return the pose of least squares weighted by the covariances of both sides, its (6, 6) covariance and chi2."""
    start = rigid_motion(own, world)
    rotation, translation = start.rotation, start.translation
    normal, chi2 = np.eye(6), 0.0
    for _ in range(_ROUNDS):
        turned = own @ rotation.T
        residual = world - turned - translation
        weight = np.linalg.inv(rotation @ own_covariance @ rotation.T + world_covariance)
        jacobian = np.concatenate(
            [np.array([-skew(p) for p in turned]), np.broadcast_to(np.eye(3), (len(own), 3, 3))], 2
        )
        weighted = np.einsum("nji,njk->nik", jacobian, weight)
        normal = np.einsum("nij,njk->ik", weighted, jacobian)
        chi2 = float(np.einsum("ni,nij,nj->", residual, weight, residual))
        step = np.linalg.solve(normal, np.einsum("nij,nj->i", weighted, residual))
        if np.abs(step).max() < 1e-10:
            break
        rotation = rotation_from_rotvec(step[:3]) @ rotation
        translation = translation + step[3:]
    u, _, vt = np.linalg.svd(rotation)
    return Rigid(u @ vt, translation), np.asarray(np.linalg.inv(normal), np.float64), chi2
