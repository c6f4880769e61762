"""Sparsity patterns of matrices with named blocks, drawn as PNG files."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from yid_ocp.analysis.sparsity_patterns import NamedRange, SparsityPattern
from yid_ocp.errors import OutputError
from yid_ocp.report.figures import LINE_COLORS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_STRUCTURAL_COLOR, _NONZERO_COLOR, _BLOCK_EDGE_COLOR = "#a9cfe0", LINE_COLORS[0], LINE_COLORS[1]
_MAX_SINGLE_LABELS = 64  # rows or columns up to which each has its own label; beyond, those of one owner share one


def draw_sparsity_patterns(path: Path, layout: Sequence[Sequence[SparsityPattern]]) -> None:
    """Write a PNG of sparsity patterns in rows, with their blocks separated and named.

    Parameters
    ----------
    path : Path
        PNG to write.
    layout : sequence of sequence of SparsityPattern
        What stands beside what; patterns without rows or columns are left out.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = [kept for row in layout if (kept := [entry for entry in row if entry.nonzero_mask.size])]
    heights = [max(_inches(entry.nonzero_mask.shape[0]) for entry in row) for row in rows]
    widths = [sum(_inches(entry.nonzero_mask.shape[1]) for entry in row) for row in rows]
    figure = Figure(figsize=(max(widths, default=4.0), max(sum(heights), 1.0)), layout="constrained")
    FigureCanvasAgg(figure)
    parts = figure.subfigures(max(len(rows), 1), 1, squeeze=False, height_ratios=heights or None)[:, 0]
    for part, row in zip(parts, rows, strict=False):
        shares = [_inches(entry.nonzero_mask.shape[1]) for entry in row]
        for axes, entry in zip(part.subplots(1, len(row), squeeze=False, width_ratios=shares)[0], row, strict=True):
            _draw(axes, entry)
    try:
        figure.savefig(path, dpi=110, format="png")
    except OSError as error:
        raise OutputError(f"the picture cannot be written: {error.strerror}", where=str(path)) from error


def _inches(count: int) -> float:
    """Room for so many rows or columns and what stands around them."""
    return 2.2 + float(np.clip(0.085 * count, 1.2, 11.0))


def _draw(axes: Axes, pattern: SparsityPattern) -> None:
    from matplotlib.colors import ListedColormap

    shown = pattern.nonzero_mask.astype(int)
    words = [
        f"{pattern.nonzero_mask.shape[0]} x {pattern.nonzero_mask.shape[1]}, {pattern.n_nonzeros} entries can differ from zero"
    ]
    if pattern.marked_mask is not None:
        shown[pattern.nonzero_mask & pattern.marked_mask] = 2
        words.append(f"dark: {np.count_nonzero(shown == 2)} {pattern.mark_label}")
    colors = ListedColormap(
        ["white", _STRUCTURAL_COLOR if pattern.marked_mask is not None else _NONZERO_COLOR, _NONZERO_COLOR]
    )
    axes.imshow(shown, cmap=colors, vmin=0, vmax=2, interpolation="none", aspect="equal", origin="upper")
    for edges, line in ((pattern.row_blocks, axes.axhline), (pattern.column_blocks, axes.axvline)):
        for span in edges[1:]:
            if span.stop > span.start:
                line(span.start - 0.5, color=_BLOCK_EDGE_COLOR, linewidth=0.7)
    axes.set_title(f"{pattern.title}\n" + "\n".join(words), fontsize=9)
    for axis, labels, spans in (
        (axes.xaxis, pattern.column_labels, pattern.column_blocks),
        (axes.yaxis, pattern.row_labels, pattern.row_blocks),
    ):
        places, names = _ticks(labels, spans)
        axis.set_ticks(places, labels=names, fontsize=5.5)
    axes.tick_params(axis="x", labelrotation=90, length=2)
    axes.tick_params(axis="y", length=2)
    named = [span for span in pattern.column_blocks if span.stop > span.start]
    # names of narrow neighbours would be written over each other
    narrow = len(named) > 8 or any(span.stop - span.start < 0.03 * pattern.nonzero_mask.shape[1] for span in named)
    top = axes.secondary_xaxis("top")
    top.set_xticks([_middle(s) for s in named], labels=[s.name for s in named], fontsize=8, color=_BLOCK_EDGE_COLOR)
    named = [span for span in pattern.row_blocks if span.stop > span.start]
    right = axes.secondary_yaxis("right")
    right.set_yticks([_middle(s) for s in named], labels=[s.name for s in named], fontsize=8, color=_BLOCK_EDGE_COLOR)
    for side in (top, right):
        side.tick_params(length=0)
    top.tick_params(axis="x", labelrotation=90 if narrow else 0)


def _middle(span: NamedRange) -> float:
    return 0.5 * (span.start + span.stop - 1)


def _ticks(labels: Sequence[str], spans: Sequence[NamedRange]) -> tuple[list[float], list[str]]:
    """Where labels go: every one, or one for all of the same owner (a tube, an arm) in a block."""
    if len(labels) <= _MAX_SINGLE_LABELS:
        return [float(i) for i in range(len(labels))], list(labels)
    places, names = [], []
    for span in spans:
        owners = [labels[i].replace(".", "_").partition("_")[0] for i in range(span.start, span.stop)]
        at = span.start
        for owner, group in groupby(owners):
            count = len(list(group))
            places.append(at + 0.5 * (count - 1))
            names.append(owner)
            at += count
    return places, names
