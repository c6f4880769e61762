"""Pictures of sparsity patterns."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.figure import Figure

from yid_ocp.analysis.step_diagnostics import NamedIndexRange, SparsityPattern
from yid_ocp.errors import OutputError
from yid_ocp.report.png_figures import _MAX_SINGLE_LABELS, draw_sparsity_patterns


@pytest.fixture
def drawn(monkeypatch):
    """Figures that were saved."""
    figures, save = [], Figure.savefig

    def keep(self, *arguments, **settings):
        figures.append(self)
        return save(self, *arguments, **settings)

    monkeypatch.setattr(Figure, "savefig", keep)
    return figures


def pattern(height=6, width=8, **more):
    mask = np.random.default_rng(0).random((height, width)) < 0.4
    rows = (
        NamedIndexRange("del", 0, height - 2),
        NamedIndexRange("internal", height - 2, height - 2),
        NamedIndexRange("constraint", height - 2, height),
    )
    columns = (NamedIndexRange("q1", 0, width - 3), NamedIndexRange("lam", width - 3, width))
    row_labels = (*(f"T{1 + i // 3}_{i % 3}_x" for i in range(height - 2)), "left.x", "left.y")
    column_labels = (*(f"T{1 + i // 3}_{i % 3}_x" for i in range(width - 3)), "left.x", "left.y", "left.z")
    return SparsityPattern("dR_dy", "a step", mask, rows, columns, row_labels, column_labels, **more)


def shown(axes):
    return np.array(axes.images[0].get_array())


def test_a_picture_shows_the_pattern_with_its_names(drawn, tmp_path):
    entry = pattern()
    draw_sparsity_patterns(tmp_path / "p.png", [[entry]])
    assert (tmp_path / "p.png").read_bytes().startswith(b"\x89PNG")
    (axes,) = drawn[0].get_axes()
    np.testing.assert_array_equal(shown(axes) > 0, entry.nonzero_mask)
    assert [label.get_text() for label in axes.get_xticklabels()] == list(entry.column_labels)
    assert [label.get_text() for label in axes.get_yticklabels()] == list(entry.row_labels)
    np.testing.assert_array_equal(axes.get_yticks(), np.arange(6))
    lines = [line.get_xydata() for line in axes.lines]
    across = [float(line[0, 1]) for line in lines if line[0, 1] == line[1, 1]]
    along = [float(line[0, 0]) for line in lines if line[0, 0] == line[1, 0]]
    # an empty block has no line of its own
    assert (across, along) == ([3.5], [4.5])
    top, right = axes.child_axes
    assert [label.get_text() for label in top.get_xticklabels()] == ["q1", "lam"]
    assert list(top.get_xticks()) == [2.0, 6.0]
    assert [label.get_text() for label in right.get_yticklabels()] == ["del", "constraint"]
    assert axes.get_title() == f"a step\n6 x 8, {entry.n_nonzeros} entries can differ from zero"


def test_marked_entries_are_told_from_the_others(drawn, tmp_path):
    entry = pattern()
    marked = np.zeros_like(entry.nonzero_mask)
    marked[:2] = True
    draw_sparsity_patterns(tmp_path / "p.png", [[pattern(marked_mask=marked, mark_label="not zero at the rest")]])
    (axes,) = drawn[0].get_axes()
    np.testing.assert_array_equal(shown(axes) == 2, entry.nonzero_mask & marked)
    np.testing.assert_array_equal(shown(axes) > 0, entry.nonzero_mask)
    assert axes.get_title().endswith(f"dark: {np.count_nonzero(entry.nonzero_mask & marked)} not zero at the rest")


def test_many_rows_share_the_label_of_their_owner(drawn, tmp_path):
    height = _MAX_SINGLE_LABELS + 9
    draw_sparsity_patterns(tmp_path / "p.png", [[pattern(height)]])
    (axes,) = drawn[0].get_axes()
    labels = [label.get_text() for label in axes.get_yticklabels()]
    owners = [f"T{1 + i // 3}" for i in range(height - 2)]
    assert labels == [*dict.fromkeys(owners), "left"]
    # three rows of T1, then of T2, ...: in the middle of each
    assert list(axes.get_yticks())[:2] == [1.0, 4.0]
    assert axes.get_yticks()[-1] == height - 1.5


def test_patterns_stand_beside_each_other_and_empty_ones_are_left_out(drawn, tmp_path):
    empty = pattern()
    empty = SparsityPattern("B_u", "no torque", np.zeros((6, 0), bool), empty.row_blocks, (), empty.row_labels, ())
    draw_sparsity_patterns(tmp_path / "p.png", [[pattern(), pattern(6, 12)], [empty], [pattern(9, 5), empty]])
    assert [shown(axes).shape for axes in drawn[0].get_axes()] == [(6, 8), (6, 12), (9, 5)]


def test_a_picture_that_cannot_be_written_is_said(tmp_path):
    with pytest.raises(OutputError, match="cannot be written") as caught:
        draw_sparsity_patterns(tmp_path / "nowhere" / "p.png", [[pattern()]])
    assert str(tmp_path / "nowhere") in str(caught.value.where)
