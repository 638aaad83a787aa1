"""The simplex, compared with SciPy's step by step."""

from __future__ import annotations

import dataclasses
import warnings

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.optimize import minimize, rosen

from ladarreg_core.errors import LadarregError, OptionError, ShapeError
from ladarreg_core.thesis.estimators.nelder_mead import nelder_mead, start_simplex
from ladarreg_core.thesis.estimators.stereo import StereoPairs, stereo_cost
from testing.scenes.room import room_case


def walked(cost, simplex, **options):
    """Return all steps and the reason for stopping."""
    steps, walk = [], nelder_mead(cost, simplex, **options)
    while True:
        try:
            steps.append(next(walk))
        except StopIteration as end:
            return steps, end.value


def assert_equal_to_scipy(cost, simplex, *, x_tolerance, cost_tolerance, most_iterations, most_evaluations):
    best = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        reference = minimize(
            cost,
            simplex[0],
            method="Nelder-Mead",
            callback=lambda intermediate_result: best.append(intermediate_result.fun),
            options={
                "initial_simplex": simplex,
                "xatol": x_tolerance,
                "fatol": cost_tolerance,
                "maxiter": most_iterations,
                "maxfev": most_evaluations,
            },
        )
    steps, stopped = walked(
        cost,
        simplex,
        x_tolerance=x_tolerance,
        cost_tolerance=cost_tolerance,
        most_iterations=most_iterations,
        most_evaluations=most_evaluations,
    )
    ours = [step.cost for step in steps[1:]]
    assert ours == pytest.approx(best[: len(ours)], rel=1e-12, abs=0)
    assert len(best) - len(ours) in (0, 1)  # SciPy reports a move twice if the evaluations ran out
    assert (steps[-1].evaluations, steps[-1].iteration) == (reference.nfev, reference.nit)
    assert steps[-1].best == pytest.approx(reference.x, rel=1e-12, abs=0)
    assert stopped == {0: "tolerance", 1: "evaluations", 2: "iterations"}[reference.status]


def kinked(x):
    """Level sets with corners, and ties between vertices."""
    return float(np.abs(x - 1).sum() + np.abs(x).max())


def bowl(x):
    return float(((x - np.arange(len(x))) ** 2 * 4.0 ** np.arange(len(x))).sum())


@st.composite
def simplices(draw):
    count = draw(st.integers(1, 6))
    whole = st.integers(-3, 3).map(float)
    elements = draw(st.sampled_from([whole, st.floats(-3, 3, width=32)]))
    return draw(hnp.arrays(np.float64, (count + 1, count), elements=elements))


@pytest.mark.slow
@given(
    simplex=simplices(),
    cost=st.sampled_from([bowl, kinked]),
    most_iterations=st.sampled_from([1, 2, 40, 600]),
    most_evaluations=st.sampled_from([1, 4, 33, 900]),
    tolerance=st.sampled_from([0.0, 1e-8, 1e-2]),
)
@settings(max_examples=120)
def test_every_step_is_scipy_s(simplex, cost, most_iterations, most_evaluations, tolerance):
    assert_equal_to_scipy(
        cost,
        simplex,
        x_tolerance=tolerance,
        cost_tolerance=tolerance,
        most_iterations=most_iterations,
        most_evaluations=most_evaluations,
    )


@given(count=st.integers(2, 6), seed=st.integers(0, 10_000))
@settings(max_examples=12)
def test_every_step_down_rosenbrock_s_valley_is_scipy_s(count, seed):
    simplex = np.random.default_rng(seed).normal(size=(count + 1, count))
    assert_equal_to_scipy(
        rosen, simplex, x_tolerance=1e-7, cost_tolerance=1e-7, most_iterations=3000, most_evaluations=3000
    )


@given(seed=st.integers(0, 10_000))
@settings(max_examples=12)
def test_every_step_down_2_21_is_scipy_s(seed):
    case = room_case(seed, count=40, baseline_m=1.0, direction=(0.1, 1.0, 0.2))
    pairs = StereoPairs.of(case.matches, case.camera)
    start = pairs.parameters(case.pose) + np.random.default_rng(seed).normal(size=6) * ([0.05] * 3 + [0.01] * 3)
    assert_equal_to_scipy(
        stereo_cost(pairs),
        start_simplex(start, [0.1] * 3 + [0.03] * 3),
        x_tolerance=1e-7,
        cost_tolerance=1e-9,
        most_iterations=800,
        most_evaluations=1200,
    )


@pytest.mark.slow
@given(seed=st.integers(0, 10_000))
@settings(max_examples=15)
def test_each_step_is_consistent(seed):
    simplex = np.random.default_rng(seed).normal(size=(4, 3))
    steps, _ = walked(rosen, simplex, most_iterations=80)
    assert steps[0].move == "start"
    for before, step in zip([None, *steps], steps, strict=False):
        assert [rosen(v) for v in step.vertices] == step.costs.tolist()
        assert (np.diff(step.costs) >= 0).all()
        assert not step.vertices.flags.writeable
        if before is None:
            continue
        kept = sum((v == step.vertices).all(axis=1).any() for v in before.vertices)
        assert kept == (1 if step.move == "shrink" else 3)
        if step.move == "shrink":
            continue
        (new,) = (v for v in step.vertices if not (v == before.vertices).all(axis=1).any())
        middle, worst = before.vertices[:-1].mean(axis=0), before.vertices[-1]
        reach = {"reflect": 1, "expand": 2, "contract_outside": 0.5, "contract_inside": -0.5}[step.move]
        assert new == pytest.approx(middle + reach * (middle - worst), abs=1e-9)
    with pytest.raises(dataclasses.FrozenInstanceError):
        steps[0].iteration = 7


@given(bad=st.sampled_from([np.nan, np.inf]), wall=st.floats(-0.9, 0.4))
@example(bad=np.nan, wall=0.0)
def test_a_nan_cost_counts_as_the_highest(bad, wall):
    def half(x):
        return bad if x[0] < wall else float(((x - [0.5, -0.3]) ** 2).sum())

    steps, stopped = walked(half, np.array([[-1.0, 0.0], [-2.0, 1.0], [1.0, 1.0]]), x_tolerance=1e-6)
    assert stopped == "tolerance"
    assert steps[-1].best == pytest.approx([0.5, -0.3], abs=1e-2)
    assert all(
        not np.isnan(step.costs).any() and (np.diff(step.costs[step.costs < np.inf]) >= 0).all() for step in steps
    )


def test_it_ends_even_if_all_costs_are_infinite():
    steps, stopped = walked(lambda x: np.nan, np.eye(3)[:, :2], most_iterations=50)
    assert stopped == "iterations"
    assert steps[-1].cost == np.inf


@pytest.mark.parametrize(
    ("simplex", "options", "error", "words"),
    [
        (np.zeros((3, 3)), {}, ShapeError, "P [+] 1 x P"),
        (np.zeros(3), {}, ShapeError, "shape"),
        ([["a"]], {}, ShapeError, "not an array"),
        (np.zeros((1, 0)), {}, ShapeError, "P [+] 1 x P"),
        ([[np.nan], [1.0]], {}, OptionError, "finite"),
        ([[0.0], [1.0]], {"x_tolerance": -1.0}, OptionError, "x_tolerance"),
        ([[0.0], [1.0]], {"cost_tolerance": np.nan}, OptionError, "cost_tolerance"),
        ([[0.0], [1.0]], {"most_iterations": 0}, OptionError, "most_iterations"),
        ([[0.0], [1.0]], {"most_evaluations": True}, OptionError, "most_evaluations"),
    ],
)
def test_invalid_arguments_are_refused_before_the_first_step(simplex, options, error, words):
    with pytest.raises(error, match=words):
        nelder_mead(bowl, simplex, **options)


def test_a_start_simplex_has_one_vertex_per_step():
    simplex = start_simplex([1.0, 2.0], [0.5, -0.1])
    assert simplex.tolist() == [[1.0, 2.0], [1.5, 2.0], [1.0, 1.9]]
    for point, steps in (([1.0], [0.0]), ([1.0], [np.inf]), ([], []), ([1.0, 2.0], [1.0]), ([1e30], [1.0])):
        with pytest.raises(LadarregError):
            start_simplex(point, steps)
