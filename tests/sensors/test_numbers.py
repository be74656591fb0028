"""Parts of graphs, against another library's."""

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from sensors.numbers import connected


@pytest.mark.parametrize("edges", [0, 3, 60, 150, 400])
@pytest.mark.parametrize("nodes", [1, 10, 200])
def test_nodes_are_in_the_parts_that_scipy_finds(nodes, edges):
    rng = np.random.default_rng([nodes, edges])
    a, b = rng.integers(0, nodes, (2, edges))
    graph = coo_array((np.ones(edges, bool), (a, b)), shape=(nodes, nodes))
    expected = connected_components(graph, directed=False)[1]
    np.testing.assert_array_equal(connected(nodes, a, b), expected)


def test_a_long_way_through_nodes_in_any_order_is_one_part():
    way = np.random.default_rng(0).permutation(20_000)
    assert not connected(len(way), way[:-1], way[1:]).any()


def test_nothing_has_no_parts():
    empty = np.zeros(0, int)
    assert connected(0, empty, empty).shape == (0,)
