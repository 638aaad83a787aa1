from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components as by_scipy

from ladarreg_core.surface.mesh.components import connected_components
from ladarreg_core.surface.mesh.subdivision import distinct


@pytest.mark.parametrize("seed", range(20))
def test_components_are_those_of_scipy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 400))
    edges = rng.integers(0, count, (int(rng.integers(0, 2 * count)), 2))
    found = connected_components(edges, count)
    links = coo_array((np.ones(len(edges), np.bool_), edges.T), shape=(count, count))
    expected = by_scipy(links, directed=False)[1]
    assert [np.flatnonzero(expected == expected[k])[0] for k in range(count)] == found.tolist()


def test_a_long_path_in_any_order_is_one_component() -> None:
    path = np.random.default_rng(0).permutation(5000)
    assert not connected_components(np.stack([path[:-1], path[1:]], axis=-1), 5000).any()


def test_without_edges_every_vertex_is_a_component_of_its_own() -> None:
    assert connected_components(np.zeros((0, 2), np.intp), 3).tolist() == [0, 1, 2]
    assert not len(connected_components(np.zeros((0, 2), np.intp), 0))


@pytest.mark.parametrize("values", [[], [3], [5, 1, 5, 5, 2], [0, 0], [-4, 7, -4]])
def test_distinct_values_are_those_of_numpy(values: list[int]) -> None:
    asked = np.array(values, np.int64)
    np.testing.assert_array_equal(distinct(asked), np.unique(asked))
    np.testing.assert_array_equal(distinct(asked[None]), np.unique(asked))
