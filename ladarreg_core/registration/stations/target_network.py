"""Scans, and a list of surveyed coordinates, joined by the targets that they share: one adjustment of poses and places.

Each of them is a body that sees targets in its own frame. Bodies are joined to clusters where three targets or more are
as far apart in both; all observations that fit the clusters are adjusted together, those that do not fit the others
are left out.

Source: Baarda 1968, 'A testing procedure for use in geodetic networks', for the tests of single observations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from ladarreg_core.errors import DegenerateGeometryError
from ladarreg_core.frames import Rigid, rotation_from_rotvec, skew
from ladarreg_core.registration.stations.target_levels import NO_LEVELS, Levels, tangents
from ladarreg_core.registration.stations.target_matching import (
    FLOOR_M,
    LEAST,
    SIGMAS,
    Array,
    chance,
    is_line,
    largest_by_chance,
    ranked_assignments,
    removal_statistics,
    rigid_motion,
)

_LEVEL_OF_ALL = 1e-4  # and all of them together for ones that contradict each other
_POSSIBLE = 16.3  # squared standard deviations with 3 degrees of freedom, exceeded once in 1000
_LIKELIER = 2 * np.log(1000.0)  # difference of two sums of squares from which one is taken and the other is not
_ROUNDS = 20
_CLOSE = 5.0  # tolerances within which two placements are one
_MIN_SHARE = 1e-13  # of the smallest eigenvalue of the normal matrix, its diagonal one


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """What sees targets in a frame of its own: a scan, or a surveyor."""

    name: str
    """For users, such as `scan hall`."""
    centers: Mapping[str, Array]
    """(3,) of each target, by name, m."""
    covariances: Mapping[str, Array]
    """(3, 3) of each, m^2."""


@dataclass(frozen=True, slots=True, eq=False)
class NetworkFit:
    """The poses of bodies and the places of targets, by all observations that are used."""

    poses: tuple[Rigid, ...]
    """`root_from_body` of each."""
    covariance: Array
    """(6 B, 6 B) of (w, c) of each in the frame of the root, whose own is zero."""
    places: dict[str, Array]
    """(3,) of each target that several bodies see, in that frame, m."""
    left_out: tuple[tuple[int, str], ...]
    """Observations that do not fit the others: index of a body, and a target."""
    chi2: float
    """Sum of the squared residuals of what is used, by their covariances."""
    dof: int
    """Its degrees of freedom."""
    levels_left_out: tuple[int, ...] = ()
    """Bodies whose level contradicts the targets and the others."""


class NotConnectedError(DegenerateGeometryError):
    """Bodies do not share enough targets with the others, or only such as leave their place open."""


def _shared_names(bodies: Sequence[Body]) -> list[str]:
    """Return the targets that two bodies or more see, in order of appearance."""
    counts: dict[str, int] = {}
    for body in bodies:
        for name in body.centers:
            counts[name] = counts.get(name, 0) + 1
    return [name for name, count in counts.items() if count > 1]


def fit_network(bodies: Sequence[Body], root: int = 0, levels: Levels | None = None) -> NetworkFit:
    """Return the poses of bodies in the frame of one of them.

    Which observations are used, the targets decide; the levels are added to these.

    Raises:
        NotConnectedError: if not all of them are joined by three targets, not on a line.
        DegenerateGeometryError: if targets contradict each other, and it cannot be decided which are wrong.
    """
    with threadpool_limits(limits=1, user_api="blas"):
        poses = _assembled(bodies, root)
        return _settled(_Observations.of(bodies, _shared_names(bodies)), poses, root, levels)


def _cannot_be_decided(count: int, of: str = "") -> DegenerateGeometryError:
    """Return the error that targets contradict each other; `of` says which."""
    return DegenerateGeometryError(
        f"the {count} targets contradict each other{of}, and it cannot be decided which is wrong; check their names "
        "and coordinates, or add targets"
    )


# --- clusters


def _assembled(bodies: Sequence[Body], root: int) -> list[Rigid]:
    """Return rough poses of all bodies in the frame of one, by what most targets agree in."""
    clusters: dict[int, dict[int, Rigid]] = {k: {k: Rigid.identity()} for k in range(len(bodies))}
    tried: dict[tuple[int, int], tuple[int, Rigid] | DegenerateGeometryError] = {}
    while len(clusters) > 1:
        both = list(combinations(clusters, 2))
        for i, j in both:
            if (i, j) not in tried:
                tried[i, j] = _joined(bodies, clusters[i], clusters[j])
        options = [(-found[0], i, j) for i, j in both if isinstance(found := tried[i, j], tuple)]
        if not options:
            raise _not_joined(bodies, list(clusters.values()), root, [tried[pair] for pair in both])
        _, i, j = min(options)
        joined = tried[i, j]
        assert isinstance(joined, tuple)
        first, second = clusters.pop(i), clusters.pop(j)
        clusters[len(tried) + len(bodies)] = first | {k: joined[1] @ own for k, own in second.items()}
    (only,) = clusters.values()
    to_root = only[root].inverse
    return [Rigid.identity() if k == root else to_root @ only[k] for k in range(len(bodies))]


def _not_joined(
    bodies: Sequence[Body], clusters: Sequence[Mapping[int, Rigid]], root: int, why: Sequence[object]
) -> DegenerateGeometryError:
    reasons = [one for one in why if isinstance(one, DegenerateGeometryError)]
    if len(bodies) == 2:
        return reasons[0]
    (own,) = (cluster for cluster in clusters if root in cluster)
    outside = [bodies[k].name for k in range(len(bodies)) if k not in own]
    inside = [bodies[k].name for k in sorted(own)]
    contradicted = [one for one in reasons if not isinstance(one, NotConnectedError)]
    kind = NotConnectedError if len(contradicted) < len(reasons) or not reasons else DegenerateGeometryError
    why = "; ".join(dict.fromkeys(str(one) for one in (contradicted or reasons)[:2]))
    return kind(f"{_listed(outside)} cannot be joined to {_listed(inside)} by targets: {why}")


def _listed(names: Sequence[str]) -> str:
    shown = list(names[:6]) + ([f"{len(names) - 6} more"] if len(names) > 6 else [])
    return shown[0] if len(shown) == 1 else f"{', '.join(shown[:-1])} and {shown[-1]}"


def _joined(
    bodies: Sequence[Body], first: Mapping[int, Rigid], second: Mapping[int, Rigid]
) -> tuple[int, Rigid] | DegenerateGeometryError:
    """Return how many targets two clusters agree in, and `first_from_second`; or why they cannot be joined."""
    ours, theirs = _points(bodies, first), _points(bodies, second)
    names = [name for name in ours if name in theirs]
    if len(names) < LEAST:
        which = f" ({', '.join(names)})" if names else ""
        return NotConnectedError(
            f"{_listed([bodies[k].name for k in first])} and {_listed([bodies[k].name for k in second])} share "
            f"{len(names)} target{'' if len(names) == 1 else 's'}{which}, and at least {LEAST} are needed; name them "
            "alike, or put up more that both see"
        )
    world, own = (np.array([points[name][0] for name in names]) for points in (ours, theirs))
    spread = np.array([np.trace(ours[name][1] + theirs[name][1]) / 3 for name in names])
    if is_line(own):
        return NotConnectedError(
            f"the targets {', '.join(names[:6])} that {_listed([bodies[k].name for k in first])} and "
            f"{_listed([bodies[k].name for k in second])} share lie on a line, about which a scanner could stand "
            "anywhere; add a target beside it"
        )
    tolerance = FLOOR_M + SIGMAS * np.sqrt(spread)
    nodes = np.repeat(np.arange(len(names))[:, None], 2, axis=1)
    ranked = list(ranked_assignments(nodes, own, world, tolerance, least_apart_m=0.0))
    ranked = [one for one in ranked if not is_line(own[[k for k, _ in one]])]
    out = len(names) - len(ranked[0]) if ranked else len(names)
    # Any three targets nearly agree: two may only be left out where four remain.
    if not ranked or len(ranked[0]) < LEAST + max(0, out - 1):
        return _cannot_be_decided(len(names), f" ({', '.join(names[:6])})")
    motions = [
        rigid_motion(own[chosen], world[chosen])
        for one in ranked if len(one) == len(ranked[0])
        for chosen in [[k for k, _ in one]]
    ]  # fmt: skip
    apart = max(float(np.abs(motions[0] @ own - other @ own).max()) for other in motions)
    if apart > _CLOSE * float(np.median(tolerance)):
        return _cannot_be_decided(len(names), f" ({', '.join(names[:6])})")
    return len(ranked[0]), motions[0]


def _points(bodies: Sequence[Body], cluster: Mapping[int, Rigid]) -> dict[str, tuple[Array, Array]]:
    """Return where a cluster sees targets, with covariances; those that its bodies see at two places are omitted."""
    seen: dict[str, list[tuple[Array, Array]]] = {}
    for k, pose in cluster.items():
        for name, center in bodies[k].centers.items():
            turned = np.asarray(pose.rotation @ bodies[k].covariances[name] @ pose.rotation.T, np.float64)
            seen.setdefault(name, []).append((np.asarray(pose @ center, np.float64), turned))
    found = {}
    for name, places in seen.items():
        points = np.array([place for place, _ in places])
        group = _largest_group(points, np.array([np.trace(covariance) / 3 for _, covariance in places]))
        if group.size:
            middle = np.asarray(points[group].mean(axis=0), np.float64)
            found[name] = middle, np.asarray(np.mean([places[k][1] for k in group], axis=0), np.float64)
    return found


def _largest_group(points: Array, variances: Array) -> NDArray[np.intp]:
    """Return which of the places (N, 3) of one target are one place; none if that is open."""
    if len(points) == 1:
        return np.zeros(1, np.intp)
    tolerance = FLOOR_M + SIGMAS * np.sqrt(variances[:, None] + variances)
    near = np.linalg.norm(points[:, None] - points, axis=-1) < tolerance
    counts = near.sum(axis=1)
    best = np.flatnonzero(near[int(np.argmax(counts))])
    if len(best) < 2 or any(counts[k] == len(best) and not near[k, best].any() for k in range(len(points))):
        return np.zeros(0, np.intp)
    return best


# --- adjustment


@dataclass(frozen=True, slots=True, eq=False)
class _Observations:
    """N observations of shared targets."""

    bodies: Sequence[Body]
    names: list[str]
    body: NDArray[np.intp]
    """(N,) index of the body."""
    target: NDArray[np.intp]
    """(N,) index of the name."""
    centers: Array
    """(N, 3) in the frame of the body, m."""
    covariances: Array
    """(N, 3, 3)."""

    @classmethod
    def of(cls, bodies: Sequence[Body], names: list[str]) -> _Observations:
        index = {name: k for k, name in enumerate(names)}
        listed = [(k, name) for k, body in enumerate(bodies) for name in body.centers if name in index]
        return cls(
            bodies, names, np.array([k for k, _ in listed]), np.array([index[name] for _, name in listed]),
            np.array([bodies[k].centers[name] for k, name in listed]),
            np.array([bodies[k].covariances[name] for k, name in listed]),
        )  # fmt: skip

    def placed(self, poses: Sequence[Rigid]) -> tuple[Array, Array]:
        """Return where the observations are by poses of their bodies, (N, 3), and their covariances (N, 3, 3)."""
        turns = np.array([pose.rotation for pose in poses])[self.body]
        shifts = np.array([pose.translation for pose in poses])[self.body]
        return (
            np.einsum("nij,nj->ni", turns, self.centers) + shifts,
            np.einsum("nij,njk,nlk->nil", turns, self.covariances, turns),
        )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class _Solution:
    poses: list[Rigid]
    places: dict[int, Array]
    """(3,) by the index of the name."""
    rows: NDArray[np.intp]
    """(n,) which observations are used."""
    off: Array
    """(n, 3) their residuals in standard deviations, place less observation."""
    jacobian: Array
    """(n, 3, P) of them, by poses and places."""
    inverse: Array
    """(P, P) covariance of the unknowns."""
    column: dict[int, int]
    """Where the unknowns of each free body begin."""
    column_of_place: dict[int, int]
    of_levels: tuple[Array, Array]
    """Derivatives (L, 2, P) and residuals (L, 2) of the levels."""

    @property
    def chi2(self) -> float:
        return float((self.off**2).sum() + (self.of_levels[1] ** 2).sum())

    @property
    def dof(self) -> int:
        return int(self.off.size + self.of_levels[1].size - self.inverse.shape[0])


def _solve(
    seen: _Observations, start: Sequence[Rigid], used: NDArray[np.bool_], root: int, levels: Levels = NO_LEVELS
) -> _Solution:
    """Return the least squares of the observations used; places that only one of them sees are none."""
    counts = np.bincount(seen.target[used], minlength=len(seen.names))
    rows = np.flatnonzero(used & (counts[seen.target] > 1))
    free = [k for k in range(len(seen.bodies)) if k != root]
    column = {k: 6 * n for n, k in enumerate(free)}
    column_of_place = {int(t): 6 * len(free) + 3 * n for n, t in enumerate(np.unique(seen.target[rows]))}
    of_up = 6 * len(free) + 3 * len(column_of_place)
    size = of_up + (0 if levels.is_known or not levels.roots else 2)
    poses = list(start)
    up = levels.first_up(poses)
    at, _ = seen.placed(poses)
    places = {t: at[rows[seen.target[rows] == t]].mean(axis=0) for t in column_of_place}
    jacobian, off, inverse = np.zeros((len(rows), 3, size)), np.zeros((len(rows), 3)), np.eye(size)
    of_levels = levels.rows(poses, up, column, size, of_up)
    for _ in range(_ROUNDS):
        at, spread = seen.placed(poses)
        root_of = np.linalg.cholesky(np.linalg.inv(spread[rows])).transpose(0, 2, 1)
        jacobian[:] = 0.0
        for n, row in enumerate(rows):
            k, t = int(seen.body[row]), int(seen.target[row])
            jacobian[n, :, column_of_place[t] : column_of_place[t] + 3] = root_of[n]
            if k in column:
                arm = at[row] - poses[k].translation
                jacobian[n, :, column[k] : column[k] + 6] = root_of[n] @ np.hstack([skew(arm), -np.eye(3)])
            off[n] = root_of[n] @ (places[t] - at[row])
        of_levels = levels.rows(poses, up, column, size, of_up)
        flat = np.vstack([jacobian.reshape(-1, size), of_levels[0].reshape(-1, size)])
        inverse = _inverse(flat.T @ flat, len(seen.names))
        step = -inverse @ (flat.T @ np.concatenate([off.ravel(), of_levels[1].ravel()]))
        for k, c in column.items():
            turn = rotation_from_rotvec(step[c : c + 3])
            u, _, vt = np.linalg.svd(turn @ poses[k].rotation)
            poses[k] = Rigid(u @ vt, poses[k].translation + step[c + 3 : c + 6])
        places = {t: place + step[column_of_place[t] :][:3] for t, place in places.items()}
        if size > of_up:
            up = up + tangents(up) @ step[of_up:]
            up /= np.linalg.norm(up)
        if np.abs(step).max(initial=0.0) < 1e-10:
            break
    return _Solution(poses, places, rows, off, jacobian, inverse, column, column_of_place, of_levels)


def _inverse(normal: Array, count: int) -> Array:
    """Return the inverse of a normal matrix; raise where the observations leave something open."""
    scale = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    values, vectors = np.linalg.eigh(normal * np.outer(scale, scale))
    if values[0] < _MIN_SHARE:
        raise _cannot_be_decided(count)
    return np.asarray(np.outer(scale, scale) * ((vectors / values) @ vectors.T))


def _settled(seen: _Observations, poses: Sequence[Rigid], root: int, levels: Levels | None) -> NetworkFit:
    used = _in_place(seen, poses)
    threshold = largest_by_chance(len(used))
    found = _solve(seen, poses, used, root)
    for _ in range(_ROUNDS):
        back = ~used & (_misfits(seen, found, used) < threshold)
        if not back.any():
            break
        used |= back
        found = _solve(seen, found.poses, used, root)
    for _ in range(_ROUNDS):
        tests = removal_statistics(found.jacobian, found.off, found.inverse)
        if tests.max(initial=0.0) < threshold and chance(found.chi2, found.dof) >= _LEVEL_OF_ALL:
            break
        if tests.max(initial=0.0) < _POSSIBLE:
            raise DegenerateGeometryError(
                f"the {len(seen.names)} targets agree less than their standard deviations allow (chi squared "
                f"{found.chi2:.0f} at {found.dof} degrees of freedom), and no single one is wrong; give a larger "
                "standard deviation of the coordinates, or check that nothing was moved between the scans"
            )
        suspects = found.rows[tests > tests.max() - _LIKELIER]
        for row in suspects:  # of only two observations it is not known which one is wrong
            same = found.rows[seen.target[found.rows] == seen.target[row]]
            used[same if len(same) == 2 else row] = False
        _check_enough(seen, used, suspects)
        found = _solve(seen, found.poses, used, root)
    else:
        raise _cannot_be_decided(len(seen.names))
    _check_enough(seen, used, np.flatnonzero(~used))
    askew: tuple[int, ...] = ()
    if levels is not None:
        found, askew = _levelled(seen, found, used, root, levels)
    size = len(seen.bodies)
    covariance = np.zeros((6 * size, 6 * size))
    own = np.concatenate([6 * k + np.arange(6) for k in found.column]).astype(np.intp)
    covariance[np.ix_(own, own)] = found.inverse[: len(own), : len(own)]
    at, _ = seen.placed(found.poses)
    places = {name: found.places[t] if t in found.places else at[seen.target == t].mean(axis=0)
              for t, name in enumerate(seen.names)}  # fmt: skip
    out = tuple((int(seen.body[row]), seen.names[seen.target[row]]) for row in np.flatnonzero(~used))
    return NetworkFit(tuple(found.poses), covariance, places, out, found.chi2, found.dof, askew)


def _levelled(
    seen: _Observations, found: _Solution, used: NDArray[np.bool_], root: int, levels: Levels
) -> tuple[_Solution, tuple[int, ...]]:
    """Return the solution with the levels that fit it, and the bodies of those that do not."""
    wrong: list[int] = []
    while levels.roots:
        found = _solve(seen, found.poses, used, root, levels)
        tests = removal_statistics(*found.of_levels, found.inverse)
        if tests.max() < largest_by_chance(len(tests), 2):
            return found, tuple(wrong)
        wrong.append(list(levels.roots)[int(np.argmax(tests))])
        levels = levels.without(wrong[-1])
    return _solve(seen, found.poses, used, root), tuple(wrong)


def _in_place(seen: _Observations, poses: Sequence[Rigid]) -> NDArray[np.bool_]:
    """Return which observations are where others of the same target are, (N,)."""
    used = np.zeros(len(seen.body), np.bool_)
    at, spread = seen.placed(poses)
    for target in range(len(seen.names)):
        rows = np.flatnonzero(seen.target == target)
        used[rows[_largest_group(at[rows], np.trace(spread[rows], axis1=1, axis2=2) / 3)]] = True
    return used


def _misfits(seen: _Observations, found: _Solution, used: NDArray[np.bool_]) -> Array:
    """Return how far each observation that is not used is from where others see it: squared, by its covariance, (N,).

    Infinite for those that are used.
    """
    off = np.full(len(used), np.inf)
    at, spread = seen.placed(found.poses)
    for row in np.flatnonzero(~used):
        target = int(seen.target[row])
        derivative = np.zeros((3, len(found.inverse)))
        own = spread[row].copy()
        if target in found.places:
            place = found.places[target]
            derivative[:, found.column_of_place[target] :][:, :3] += np.eye(3)
        else:
            others = [k for k in np.flatnonzero(seen.target == target) if k != row]
            if len(others) != 1:
                continue
            place, own = at[others[0]], own + spread[others[0]]
            _add_pose(derivative, found, int(seen.body[others[0]]), place, 1.0)
        _add_pose(derivative, found, int(seen.body[row]), at[row], -1.0)
        covariance = derivative @ found.inverse @ derivative.T + own
        off[row] = float((place - at[row]) @ np.linalg.solve(covariance, place - at[row]))
    return off


def _add_pose(derivative: Array, found: _Solution, body: int, at: Array, sign: float) -> None:
    if body in found.column:
        arm = at - found.poses[body].translation
        derivative[:, found.column[body] :][:, :6] += sign * np.hstack([-skew(arm), np.eye(3)])


def _check_enough(seen: _Observations, used: NDArray[np.bool_], wrong: NDArray[np.intp]) -> None:
    """Raise an error where so much is left out of a body that what remains may agree by chance."""
    for k, body in enumerate(seen.bodies):
        own = np.flatnonzero(seen.body == k)
        out = int((~used[own]).sum())
        kept = seen.centers[own[used[own]]]
        if out and (len(kept) < LEAST + out - 1 or is_line(kept)):
            named = ", ".join(dict.fromkeys(seen.names[seen.target[row]] for row in wrong[:6]))
            raise _cannot_be_decided(len(own), f" (in {body.name}: {named})")
