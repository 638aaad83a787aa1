"""The downhill simplex method as a generator of frozen steps.

Source: Nelder and Mead, A simplex method for function minimization (1965). The order of evaluations, the handling of
ties and the stopping rule are SciPy's (`minimize(method="Nelder-Mead", initial_simplex=...)`); the steps are identical.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from ladarreg_core.errors import OptionError, ShapeError
from ladarreg_core.foundations.arrays import FloatArray, read_only
from ladarreg_core.foundations.validation import require_int

Move = Literal["start", "reflect", "expand", "contract_outside", "contract_inside", "shrink"]
Stopped = Literal["tolerance", "iterations", "evaluations"]
Cost = Callable[[FloatArray], float]
"""Cost of parameters (P,); NaN counts as infinite. It must not keep or modify the array."""

_REFLECT, _EXPAND, _CONTRACT, _SHRINK = 1.0, 2.0, 0.5, 0.5


@dataclass(frozen=True, slots=True, eq=False)
class SimplexStep:
    """The simplex after one move."""

    iteration: int
    """1 for the start, then counting up, as SciPy's `nit`."""
    move: Move
    """The move that led to this simplex."""
    vertices: FloatArray
    """(P + 1, P), the best first."""
    costs: FloatArray
    """(P + 1,), lowest first; infinite if the cost was NaN."""
    evaluations: int
    """Evaluations of the cost so far."""

    @property
    def best(self) -> FloatArray:
        """(P,) the best vertex."""
        return np.asarray(self.vertices[0])

    @property
    def cost(self) -> float:
        """The best vertex's cost."""
        return float(self.costs[0])


def start_simplex(point: ArrayLike, steps: ArrayLike) -> FloatArray:
    """Return the simplex (P + 1, P) of a point (P,) and one vertex a step (P,) away along each parameter.

    Raises:
        ShapeError: if the shapes disagree or are empty.
        OptionError: if a number is not finite, or a step does not change its parameter.
    """
    origin = read_only(point, np.float64, (None,), "the simplex's start")
    sides = read_only(steps, np.float64, (len(origin),), "the simplex's steps")
    if not len(origin):
        raise ShapeError("the start of the simplex has no parameters; it needs at least one")
    if not (np.isfinite(origin).all() and np.isfinite(sides).all()):
        raise OptionError("the start of the simplex or a step is not finite; give finite numbers")
    simplex = np.vstack([origin, origin + np.diag(sides)])
    if (np.diag(simplex[1:]) == origin).any():
        raise OptionError("a step of the simplex does not change its parameter; give a non-zero step for each")
    return simplex


def nelder_mead(
    cost: Cost,
    simplex: ArrayLike,
    *,
    x_tolerance: float = 1e-4,
    cost_tolerance: float = 1e-4,
    most_iterations: int = 1200,
    most_evaluations: int = 1200,
) -> Generator[SimplexStep, None, Stopped]:
    """Minimise a cost from an initial simplex, one step per move; the last step is the result.

    Args:
        cost: the cost to minimise.
        simplex: (P + 1, P) vertices of the initial simplex.
        x_tolerance: stop when no vertex differs from the best by more than this in any parameter, and
        cost_tolerance: no cost differs from the lowest by more than this.
        most_iterations: stop at this `iteration`.
        most_evaluations: stop after this many evaluations.

    Yields:
        The initial simplex, then the simplex after every move. If the evaluations run out during a move, the incomplete
        simplex is yielded with the previous iteration number.

    Returns:
        The reason for stopping.

    Raises:
        ShapeError: if the number of vertices is not one more than that of the parameters.
        OptionError: if a vertex is not finite, a tolerance is negative, or a limit is not a positive integer.
    """
    given = read_only(simplex, np.float64, (None, None), "the simplex")
    if len(given) < 2 or len(given) != given.shape[1] + 1:
        raise ShapeError(f"the simplex has the shape {len(given)} x {given.shape[1]}; it must be P + 1 x P")
    if not np.isfinite(given).all():
        raise OptionError("the simplex contains NaN or infinity; its vertices must be finite")
    for name, tolerance in (("x_tolerance", x_tolerance), ("cost_tolerance", cost_tolerance)):
        if not tolerance >= 0:
            raise OptionError(f"{name} is {tolerance!r}; it must be at least 0")
    for name, limit in (("most_iterations", most_iterations), ("most_evaluations", most_evaluations)):
        require_int(limit, f"{name}", least=1)
    return _iterate(_Counted(cost, most_evaluations), given, x_tolerance, cost_tolerance, most_iterations)


class _SpentError(Exception):
    """The limit of evaluations is reached."""


@dataclass(slots=True)
class _Counted:
    """A cost that counts its evaluations and returns infinity instead of NaN."""

    cost: Cost
    most: int
    count: int = 0

    def __call__(self, x: FloatArray) -> float:
        if self.count >= self.most:
            raise _SpentError
        self.count += 1
        value = float(self.cost(x))
        return value if value == value else np.inf


def _iterate(
    cost: _Counted, given: FloatArray, x_tolerance: float, cost_tolerance: float, most_iterations: int
) -> Generator[SimplexStep, None, Stopped]:
    vertices, count = np.array(given), given.shape[1]
    costs = np.full(count + 1, np.inf)
    try:
        for k in range(count + 1):
            costs[k] = cost(vertices[k])
    except _SpentError:
        pass
    vertices, costs = _sorted(vertices, costs)
    vertices, costs = _sorted(vertices, costs)  # twice, as SciPy does, for the same order of ties
    iteration = 1
    move: Move = "start"
    yield _step(iteration, move, vertices, costs, cost)
    while cost.count < cost.most and iteration < most_iterations:
        # inf - inf is NaN: infinite costs never count as converged
        level = costs[-1] < np.inf and costs[-1] - costs[0] <= cost_tolerance
        if level and np.abs(vertices[1:] - vertices[0]).max() <= x_tolerance:
            return "tolerance"
        try:
            move = _improve(cost, vertices, costs)
            if move == "shrink":
                for k in range(1, count + 1):
                    vertices[k] = vertices[0] + _SHRINK * (vertices[k] - vertices[0])
                    costs[k] = cost(vertices[k])
        except _SpentError:
            vertices, costs = _sorted(vertices, costs)
            yield _step(iteration, move, vertices, costs, cost)
            break
        iteration += 1
        vertices, costs = _sorted(vertices, costs)
        yield _step(iteration, move, vertices, costs, cost)
    return "evaluations" if cost.count >= cost.most else "iterations"


def _improve(cost: _Counted, vertices: FloatArray, costs: FloatArray) -> Move:
    """Replace the worst vertex in place, or return that the simplex must shrink."""
    worst = vertices[-1]
    middle = np.add.reduce(vertices[:-1], 0) / len(worst)

    def along(reach: float) -> FloatArray:
        """Return the point at `reach` from the centroid, away from the worst vertex."""
        return np.asarray((1 + reach) * middle - reach * worst)

    def take(point: FloatArray, value: float, move: Move) -> Move:
        vertices[-1], costs[-1] = point, value
        return move

    reflected = along(_REFLECT)
    there = cost(reflected)
    if there < costs[0]:
        expanded = along(_REFLECT * _EXPAND)
        further = cost(expanded)
        return take(expanded, further, "expand") if further < there else take(reflected, there, "reflect")
    if there < costs[-2]:
        return take(reflected, there, "reflect")
    if there < costs[-1]:
        outside = along(_CONTRACT * _REFLECT)
        nearer = cost(outside)
        return take(outside, nearer, "contract_outside") if nearer <= there else "shrink"
    inside = along(-_CONTRACT)
    nearer = cost(inside)
    return take(inside, nearer, "contract_inside") if nearer < costs[-1] else "shrink"


def _sorted(vertices: FloatArray, costs: FloatArray) -> tuple[FloatArray, FloatArray]:
    order = np.argsort(costs)
    return vertices[order], costs[order]


def _step(iteration: int, move: Move, vertices: FloatArray, costs: FloatArray, cost: _Counted) -> SimplexStep:
    frozen, values = vertices.copy(), costs.copy()
    frozen.flags.writeable = values.flags.writeable = False
    return SimplexStep(iteration, move, frozen, values, cost.count)
