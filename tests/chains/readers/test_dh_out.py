"""Tables of Denavit, Hartenberg and Hayati against the chains that they were made of."""

from dataclasses import replace

import numpy as np
import pytest

from chains import se3
from chains.frames import FrameTree
from chains.readers.dh_out import table_of

from ..arms import TABLES, edges_of


def placed(table, kinds, q):
    """T_base_tip by the table alone."""
    T, last = table.T_base_first, q[-1]
    for link, value in zip(table.links, q[:-1], strict=True):
        T = T @ link.matrix(value)
    motion = [0, 0, last, 0, 0, 0] if kinds[-1] == "revolute" else [0, 0, 0, 0, 0, last]
    return T @ se3.exp(np.array(motion, float)) @ table.T_last_tip


@pytest.mark.parametrize("off", [0.0, 1e-3])
@pytest.mark.parametrize("name", TABLES)
def test_a_table_is_the_chain(tmp_path, name, off):
    """As drawn, and off by 1 mm and 1 mrad in all ways: then too no number runs away."""
    drawn, rng = edges_of(tmp_path, name), np.random.default_rng(1)
    bend = [se3.exp(off * rng.normal(size=6)) for _ in drawn]
    pairs = zip(drawn, bend, strict=True)
    edges = [replace(e, T_parent_child=e.T_parent_child @ T) for e, T in pairs]
    tree, table = FrameTree(edges), table_of(edges, drawn)
    kinds = [e.joint.kind for e in edges if e.joint is not None]
    for q in rng.uniform(-2, 2, (5, len(kinds))):
        T = tree.place("arm_end", q[None]).Ts_root_frame[0]
        np.testing.assert_allclose(placed(table, kinds, q), T, atol=1e-12)
    assert [link.joint for link in table.links] == list(tree.joint_names[:-1])
    for ours, nominal in zip(table.links, table_of(drawn, drawn).links, strict=True):
        numbers = [
            [v for v in vars(row).values() if not isinstance(v, str)] for row in (ours, nominal)
        ]
        apart = np.abs(np.subtract(*numbers))
        apart[0] = np.abs((apart[0] + np.pi) % (2 * np.pi) - np.pi)
        assert apart.max() < 30 * off + 1e-12
