"""Figures written as PNG: sparsity patterns, convergence of methods, blind validation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from yid_ocp.analysis.compare import MethodComparison
from yid_ocp.analysis.sparsity_patterns import NamedRange, SparsityPattern
from yid_ocp.errors import OutputError
from yid_ocp.report.figures import LINE_COLORS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def draw_convergence(path: Path, comparison: MethodComparison) -> None:
    """Write a PNG of each method's relative excess cost over iterations and over wall time.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 4.4), layout="constrained")
    by_iteration, by_time = figure.subplots(1, 2, sharey=True)
    for run in comparison.method_results:
        history = [entry for entry in run.solution.history if np.isfinite(entry.cost) and not entry.note]
        if not history:
            continue
        least = min(entry.cost for entry in history)
        relative = [max(entry.cost / max(least, 1e-300) - 1.0, 1e-9) for entry in history]
        by_iteration.plot(range(len(history)), relative, marker=".", label=run.method)
        by_time.plot([entry.seconds for entry in history], relative, marker=".", label=run.method)
    for axes, label in ((by_iteration, "iteration"), (by_time, "wall time [s]")):
        if axes.get_xlim()[1] > 2.0:  # below that it is linear all over, and has no ticks of its own
            axes.set_xscale("symlog", linthresh=1.0)
        axes.set_yscale("log")
        axes.set_xlim(left=0.0)
        axes.set_xlabel(label)
        axes.grid(alpha=0.3)
    by_iteration.set_ylabel("cost over its lowest value, less one")
    by_iteration.legend()
    _save(figure, path)


def draw_blind_results(folder: Path, result: Mapping[str, Any]) -> None:
    """Write `detection.png`, `confusion.png` and `calibration.png` of a `yid-blind/1` result.

    Detection against size with binomial 95 % intervals, what was said of what, and whether intervals and p-values keep
    what they promise.

    Raises
    ------
    OutputError
        A file cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.6, 4.0), layout="constrained")
    axes = figure.subplots()
    lines = (
        ("gap", "gap seen", 0.95),
        ("first", "kind and place first", 1.0),
        ("right", "alone or in a set of three", 1.05),
    )
    for key, label, shift in lines:
        known = {float(size): own[key] for size, own in result["detection_intervals"].items()}
        _rates(axes, [shift * size for size in known], list(known.values()), label)
    axes.set_xscale("log")
    axes.set_xlabel("size over the detectable size")
    axes.set_ylabel("part of the cases")
    axes.set_ylim(-0.03, 1.03)
    axes.grid(alpha=0.3)
    if result["detection"]:
        axes.legend(loc="lower right")
    _save(figure, folder / "detection.png")

    shown = result["confusion"]
    rows, columns = shown["true"], shown["said"]
    figure = Figure(figsize=(3.0 + 0.34 * len(columns), 2.2 + 0.26 * len(rows)), layout="constrained")
    axes = figure.subplots()
    counts = np.array(shown["counts"], float).reshape(len(rows), len(columns))
    parts = counts / np.maximum(counts.sum(1, keepdims=True), 1.0)
    if rows:
        axes.imshow(parts, cmap="Blues", vmin=0.0, vmax=1.0)
    for i, j in zip(*np.nonzero(counts), strict=True):
        colour = "white" if parts[i, j] > 0.5 else "black"
        axes.text(j, i, f"{counts[i, j]:.0f}", ha="center", va="center", fontsize=8, color=colour)
    axes.set_xticks(range(len(columns)), columns, rotation=90)
    axes.set_yticks(range(len(rows)), rows)
    axes.set_xlabel("said first")
    axes.set_ylabel("true")
    _save(figure, folder / "confusion.png")

    figure = Figure(figsize=(5.0, 4.6), layout="constrained")
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], color="grey", linewidth=1)
    words = {"intervals": "intervals of effects' parameters", "p_values": "p-values of clean recordings"}
    for key, label in words.items():
        entries = [entry for entry in result["calibration"][key] if entry["of"]]
        _rates(axes, [entry["level"] for entry in entries], entries, label)
    axes.set_xlabel("promised")
    axes.set_ylabel("kept")
    axes.grid(alpha=0.3)
    if any(entry["of"] for key in words for entry in result["calibration"][key]):
        axes.legend(loc="upper left")
    _save(figure, folder / "calibration.png")


def _rates(axes: Any, places: list[float], rates: list[Mapping[str, Any]], label: str) -> None:
    if rates:
        values = np.array([own["rate"] for own in rates])
        low, high = (np.array([own[key] for own in rates]) for key in ("low", "high"))
        spread = [np.maximum(values - low, 0.0), np.maximum(high - values, 0.0)]
        axes.errorbar(places, values, yerr=spread, marker="o", capsize=3, label=label)


def _save(figure: Figure, path: Path) -> None:
    try:
        figure.savefig(path, dpi=120)
    except OSError as error:
        raise OutputError(f"the picture cannot be written: {error.strerror}", where=str(path)) from error


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
    return 2.2 + float(np.clip(0.085 * count, 1.2, 11.0))


def _draw(axes: Axes, pattern: SparsityPattern) -> None:
    from matplotlib.colors import ListedColormap

    shown = pattern.nonzero_mask.astype(int)
    height, width = pattern.nonzero_mask.shape
    words = [f"{height} x {width}, {pattern.n_nonzeros} entries can differ from zero"]
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
