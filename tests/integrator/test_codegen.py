"""Index tables of the generated kernel."""

from __future__ import annotations


def test_elimination_fills_no_more_than_the_tree(single_step):
    """Tips before roots and multipliers last: a pivot touches its ancestors, and the multipliers of grasps below it."""
    tables, system = single_step.model.index_tables, single_step.system
    size = len(tables.elimination_order)
    names = [*system.mechanism.joint_names, *[f"lam{i}" for i in range(system.n_constraints)]]
    ordered = [names[i] for i in tables.unknown_rows[tables.elimination_order]]
    assert ordered[0] == "T3_3_z"
    assert ordered[-3:] == ["lam0", "lam1", "lam2"]
    tip = [ordered[i] for i in tables.fill_in[0]]
    tree = system.mechanism
    chain = [tree.joint_names[i] for i in tree.ancestor_joints(tree.joint_index("T3_3_z"))]
    assert tip == chain[-2::-1]
    assert sum(len(entries) for entries in tables.fill_in) < 0.75 * size * (size - 1) / 2
