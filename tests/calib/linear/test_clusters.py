"""Products of rows of which those side by side have few columns, against dense ones."""

import numpy as np
from scipy.sparse import csr_array

from calib.linear import clusters


def test_products_in_any_order_are_added_to_what_is_there(monkeypatch):
    """Some rows at once, rows of nothing and columns that stand twice in a row among them."""
    monkeypatch.setattr(clusters, "CLUSTERS_AT_ONCE", 4)
    rng = np.random.default_rng(0)
    count = rng.integers(0, 6, 23)
    count[4] = 0
    entries = rng.normal(size=count.sum()), rng.integers(0, 9, count.sum())
    rows = csr_array((*entries, np.append(0, np.cumsum(count))), shape=(23, 9))
    by, there = rng.normal(size=(9, 5)), rng.normal(size=(23, 5))
    out = there.copy()
    clusters.add_product(out, rows, by, rng.permutation(23))
    np.testing.assert_allclose(out, there + rows.toarray() @ by, atol=1e-12)
