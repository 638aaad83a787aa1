"""The normal equations of a mount by the planes that its sweeps see several times, the planes eliminated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.acquisition.alignment.voxel_planes import MIN_ACROSS, SharedPlanes
from ladarreg_core.foundations.arrays import BoolArray, FloatArray, IntArray

_HUBER = 3.0
_UNDETERMINED = 0.003  # m, and rad at one metre: a wider uncertainty is no measurement of a mount
CERTAIN_M = 1e-6
_LONGEST_STEP = 0.04  # m, and rad at one metre
_FEW_PLANES = 2.0  # planes whose word is worth nothing: what fewer show, others cannot check
_PRIOR_POINTS = 10
_MAD = 1.4826
_DISAGREE = 0.02  # share of the planes whose views disagree so much by chance
_TRIMMINGS = 8
_MIN_SHARE = 1e-6
_MEDIAN_CHI2 = 0.85  # the median of chi^2 / dof with about four degrees of freedom
_HELD_RAD = float(np.radians(0.5))
"""What a rotation that is not determined is thought to be off by."""


@dataclass(frozen=True, slots=True, eq=False)
class Returns:
    """The returns that are used, flat."""

    local: NDArray[np.float64]
    """(N, 3) m, scanner frame."""
    view: IntArray
    """(N,)."""
    pan: NDArray[np.float64]
    tilt: NDArray[np.float64]
    pan_rate: NDArray[np.float64]
    tilt_rate: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class MountEquations:
    """The normal equations with the planes eliminated, in scaled units."""

    information: NDArray[np.float64]
    """(P, P) for a range noise of one metre."""
    gradient: NDArray[np.float64]
    """(P,)."""
    scores: NDArray[np.float64]
    """(K, P) gradient of each plane."""
    shares: NDArray[np.float64]
    """(K, P, P) information of each plane."""
    sigma_m: float
    """Noise of the ranges."""
    points: int
    """Points that count."""
    weakest_m: float
    """Largest standard deviation of what counts as determined, m, and rad at one metre."""


def equations_of(
    returns: Returns,
    world: FloatArray,
    rays: FloatArray,
    found: SharedPlanes,
    scale: FloatArray,
    level: FloatArray,
    *,
    trimmed: bool = False,
    weakest: float = np.inf,
) -> MountEquations:
    """Build the normal equations and eliminate the planes' own unknowns: offset and two inclinations each.

    Args:
        returns: the returns.
        world: (N, 3) m, where they are with the present mount.
        rays: (N, 3) unit, along which they were measured.
        found: the planes, and the returns on them.
        scale: (P,) what one metre of movement at one metre's distance is in each unknown.
        level: (3, 3) axes of the unknowns, as rows, in the unit's frame.
        trimmed: leave out planes whose views disagree.
        weakest: largest standard deviation of what counts as determined, in noises of a range.
    """
    at, plane, planes = found.point, found.plane, found.count
    normal = found.normals[plane]
    off = world[at] - found.centres[plane]
    residual = (off * normal).sum(-1)
    pan, tilt = returns.pan[at], returns.tilt[at]
    across = (rays[at] * normal).sum(-1)
    spread = np.sqrt(across**2 + MIN_ACROSS**2)  # noise along the ray, as it acts across the plane
    scaled = residual / spread
    usual = _MAD * float(np.median(np.abs(scaled)))
    # Dark, far and grazing surfaces are noisier: each patch has its own noise, and that of all where it has few points.
    clipped = np.minimum(scaled**2, (_HUBER * usual) ** 2)
    count = np.bincount(found.patch)
    own_noise = np.bincount(found.patch, clipped) + _PRIOR_POINTS * usual**2
    spread = spread * np.sqrt(own_noise / (count + _PRIOR_POINTS))[found.patch] / usual
    weight = np.minimum(1.0, _HUBER * usual / np.maximum(np.abs(residual / spread), 1e-12)) / spread**2

    # The rows are taken where the ray meets the plane: with the noise of the range in them they would be correlated
    # with the residuals.
    across = np.where(across < 0, -1, 1) * np.maximum(np.abs(across), MIN_ACROSS)
    onto = -(residual / across)[:, None]
    off = off + onto * rays[at]
    met = world[at] + onto * rays[at]
    in_unit = _from_world(normal, pan, tilt)
    q = _from_world(met, pan, tilt)
    J = [in_unit @ level.T, np.cross(q, in_unit) @ level.T]
    if len(scale) > 6:
        by_pan = normal[:, 1] * met[:, 0] - normal[:, 0] * met[:, 1]
        # Tilting up moves a point by (-y) x p in the frame that pans; its normal there is that of the unit, turned up.
        by_tilt = in_unit[:, 2] * q[:, 0] - in_unit[:, 0] * q[:, 2]
        J.append((by_pan * returns.pan_rate[at] + by_tilt * returns.tilt_rate[at])[:, None])
    jacobian = np.concatenate(J, axis=1) * scale
    helper = np.where(np.abs(found.normals[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    u = np.cross(helper, found.normals)
    u /= np.linalg.norm(u, axis=-1, keepdims=True)
    v = np.cross(found.normals, u)
    own = np.stack([np.ones(len(at)), (off * u[plane]).sum(-1), (off * v[plane]).sum(-1)], axis=-1)

    unknowns = jacobian.shape[1]
    D = _sums(plane, planes, own * weight[:, None], own)
    C = _sums(plane, planes, jacobian * weight[:, None], own)
    h = _sums(plane, planes, own * weight[:, None], residual[:, None])[..., 0]
    explained = np.linalg.solve(D, np.concatenate([C.transpose(0, 2, 1), h[..., None]], axis=-1))
    # What remains of each row when the planes have adapted themselves.
    left = jacobian - np.einsum("ni,nij->nj", own, explained[plane][:, :, :unknowns])
    rest = residual - (own * explained[plane][:, :, unknowns]).sum(-1)
    scores = _sums(plane, planes, left, (weight * rest)[:, None])[..., 0]
    shares = _sums(plane, planes, left * weight[:, None], left)
    squares = np.bincount(plane, weight * rest**2, planes).astype(np.float64)
    count = np.bincount(plane, minlength=planes)
    if trimmed:
        agree = _agreeing(scores, shares, squares, count)
        scores, shares, squares, count = scores[agree], shares[agree], squares[agree], count[agree]
    dof = max(1, int(count.sum()) - 3 * len(count) - unknowns)
    sigma = float(np.sqrt(squares.sum() / dof))
    return MountEquations(
        shares.sum(axis=0),
        scores.sum(axis=0),
        scores,
        shares,
        sigma,
        int(count.sum()),
        min(_UNDETERMINED, weakest * max(sigma, CERTAIN_M)),
    )


def _agreeing(scores: FloatArray, shares: FloatArray, squares: FloatArray, count: IntArray) -> BoolArray:
    """Return the planes (K,) whose views agree with the others about the mount as well as their noise lets them.

    What remains of a plane's score after the step is chi^2 distributed if all its views saw one surface. A plane of two
    surfaces, each seen by another view, has a score that many good planes do not make up for.
    """
    from scipy.stats import chi2

    values, axes = np.linalg.eigh(shares)
    use = values > _MIN_SHARE * values[:, -1:]
    rank = use.sum(axis=1)
    keep = np.ones(len(scores), np.bool_)
    limit = chi2.isf(_DISAGREE, rank)
    for _ in range(_TRIMMINGS):
        information, unknowns = shares[keep].sum(axis=0), shares.shape[1]
        variance = squares[keep].sum() / max(1, count[keep].sum() - 3 * keep.sum() - unknowns)
        strength, directions = np.linalg.eigh(information)
        along = np.where(strength > variance / _UNDETERMINED**2, 1 / np.maximum(strength, 1e-300), 0.0)
        step = -directions @ (along * (directions.T @ scores[keep].sum(axis=0)))
        left = np.einsum("kij,ki->kj", axes, scores + shares @ step)
        off = np.where(use, left**2 / np.where(use, values, 1.0), 0.0).sum(axis=1) / variance
        usual = max(1.0, float(np.median(off[keep] / rank[keep])) / _MEDIAN_CHI2)
        new = off < limit * usual
        if (new == keep).all():
            break
        keep = new
    return keep


def _sums(plane: IntArray, planes: int, a: FloatArray, b: FloatArray) -> NDArray[np.float64]:
    """Return the sum of a_i b_i^T over each plane, (K, A, B)."""
    out = np.empty((planes, a.shape[1], b.shape[1]))
    for i in range(a.shape[1]):
        for j in range(b.shape[1]):
            out[:, i, j] = np.bincount(plane, a[:, i] * b[:, j], planes)
    return out


def _from_world(vectors: FloatArray, pan: FloatArray, tilt: FloatArray) -> NDArray[np.float64]:
    """Return directions of the world in the frame that pans and tilts: the inverse of `turned_by_unit`."""
    c, s = np.cos(pan), np.sin(pan)
    ahead = c * vectors[:, 0] + s * vectors[:, 1]
    left = c * vectors[:, 1] - s * vectors[:, 0]
    ct, st = np.cos(tilt), np.sin(tilt)
    return np.stack([ct * ahead + st * vectors[:, 2], left, ct * vectors[:, 2] - st * ahead], axis=-1)


def _seen(system: MountEquations) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Return eigenvalues and eigenvectors of the information, and which of them the sweeps determine."""
    values, axes = np.linalg.eigh(system.information)
    sigma = max(system.sigma_m, CERTAIN_M)
    return values, axes, values > (sigma / system.weakest_m) ** 2


def step_of(system: MountEquations, since_start: FloatArray) -> NDArray[np.float64]:
    """Return the step of Gauss and Newton in the directions that are determined; others go back to where they began."""
    values, axes, seen = _seen(system)
    along = np.where(seen, -(axes.T @ system.gradient) / np.where(seen, values, 1.0), -(axes.T @ since_start))
    step = axes @ along
    return np.asarray(step * min(1.0, _LONGEST_STEP / max(float(np.abs(step).max()), 1e-12)))


def covariance_of(system: MountEquations, scale: FloatArray) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the covariance (P, P), and which parameters (P,) are determined.

    Residuals of one plane are correlated where the plane is not quite flat or its ranges are biased. The covariance of
    independent residuals is enlarged by as much as the scores of whole planes scatter more than it predicts; they are
    corrected for the plane's own share in the solution (CR2 of Bell and McCaffrey 2002). What only a few planes show is
    less certain than their noise: nothing says whether they are what they seem.
    """
    values, axes, seen = _seen(system)
    whiten = axes[:, seen] / np.sqrt(values[seen])
    white = system.scores @ whiten
    share, turn = np.linalg.eigh(whiten.T @ system.shares @ whiten)
    corrected = np.einsum("kij,ki->kj", turn, white) / np.sqrt(np.clip(1 - share, 0.05, 1))
    scatter = float((corrected**2).sum() / max(1, int(seen.sum())))
    variance = max(system.sigma_m**2, scatter)
    of_planes = np.einsum("ip,kij,jp->kp", whiten, system.shares, whiten, optimize=True)
    support = 1 / (of_planes**2).sum(axis=0)  # each column adds up to one: as many planes of equal weight
    whiten = whiten * np.sqrt(1 + _FEW_PLANES / support)
    covariance = whiten @ whiten.T * variance * np.outer(scale, scale)
    determined = (axes[:, ~seen] ** 2).sum(axis=1) < 1e-3
    # Rotations do not commute: two that are held, and wrong, turn about the third axis as well.
    for axis in range(3):
        if not determined[3 + (axis + 1) % 3] and not determined[3 + (axis + 2) % 3]:
            covariance[3 + axis, 3 + axis] += (_HELD_RAD**2 / 2) ** 2
    covariance[~determined] = 0
    covariance[:, ~determined] = 0
    covariance[~determined, ~determined] = np.inf
    return covariance, determined
