"""Figures that are written as PNG files: sparsity patterns and the results of a blind test."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from yid_ocp.analysis.step_diagnostics import NamedIndexRange, SparsityPattern
from yid_ocp.files import atomic_write
from yid_ocp.report.figures import LINE_PALETTE, asymmetric_error_bars

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def draw_blind_validation_figures(folder: Path, result: Mapping[str, Any]) -> list[Path]:
    """Draw `detection.png`, `confusion.png` and `calibration.png` from a `yid-blind/1` result, and return their paths.

    The figures show the detection rate over the effect size with binomial 95 % intervals, the first answer against the
    true effect, and observed against nominal rates of intervals and p-values. Raises `OutputError` if writing fails.
    """
    from matplotlib.figure import Figure

    lines = {"gap": ("gap seen", 0.95), "first": ("kind and place first", 1.0)}
    lines["right"] = ("named first, or in a set of at most three", 1.05)
    rates = {float(size): own for size, own in result["detection_intervals"].items()}
    sizes = {label: {shift * size: rates[size][key] for size in rates} for key, (label, shift) in lines.items()}
    figure = Figure(figsize=(5.6, 4.0), layout="constrained")
    axes = figure.subplots()
    _draw_rates(axes, sizes, "lower right")
    axes.set(xscale="log", xlabel="size over the detectable size", ylabel="part of the cases", ylim=(-0.03, 1.03))
    files = [folder / f"{name}.png" for name in ("detection", "confusion", "calibration")]
    _save(figure, files[0])

    rows, columns = result["confusion"]["true"], result["confusion"]["said"]
    figure = Figure(figsize=(3.0 + 0.34 * len(columns), 2.2 + 0.26 * len(rows)), layout="constrained")
    axes = figure.subplots()
    counts = np.array(result["confusion"]["counts"], float).reshape(len(rows), len(columns))
    parts = counts / np.maximum(counts.sum(1, keepdims=True), 1.0)
    if rows:
        axes.imshow(parts, cmap="Blues", vmin=0.0, vmax=1.0)
    for i, j in zip(*np.nonzero(counts), strict=True):
        color = "white" if parts[i, j] > 0.5 else "black"
        axes.text(j, i, f"{counts[i, j]:.0f}", ha="center", va="center", fontsize=8, color=color)
    axes.set_xticks(range(len(columns)), columns, rotation=90)
    axes.set_yticks(range(len(rows)), rows)
    axes.set(xlabel="said first", ylabel="true")
    _save(figure, files[1])

    figure = Figure(figsize=(5.0, 4.6), layout="constrained")
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], color="grey", linewidth=1)
    labels = {"intervals": "intervals of effects' parameters", "p_values": "p-values of clean recordings"}
    labels["probabilities"] = "probabilities of named sets"
    levels = {label: [own for own in result["calibration"][key] if own["of"]] for key, label in labels.items()}
    _draw_rates(axes, {label: {own["level"]: own for own in known} for label, known in levels.items()}, "upper left")
    axes.set(xlabel="promised", ylabel="kept")
    _save(figure, files[2])
    return files


def _draw_rates(
    axes: Axes, curves: Mapping[str, Mapping[float, Mapping[str, float]]], corner: Literal["lower right", "upper left"]
) -> None:
    for label, known in curves.items():
        if known:
            values, low, high = ([own[key] for own in known.values()] for key in ("rate", "low", "high"))
            bars = asymmetric_error_bars(values, low, high)
            spread = [bars["arrayminus"], bars["array"]]
            axes.errorbar(list(known), values, yerr=spread, marker="o", capsize=3, label=label)
    axes.grid(alpha=0.3)
    if any(curves.values()):
        axes.legend(loc=corner)


def _save(figure: Figure, path: Path, dpi: int = 120) -> None:
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=dpi, format="png")


_STRUCTURAL_COLOR, _NONZERO_COLOR, _BLOCK_EDGE_COLOR = "#a9cfe0", LINE_PALETTE[0], LINE_PALETTE[1]
_MAX_SINGLE_LABELS = 64  # with more rows or columns, one label per owner (tube, arm) instead of one each


def draw_sparsity_patterns(path: Path, layout: Sequence[Sequence[SparsityPattern]]) -> None:
    """Write the sparsity patterns of `layout` (rows of patterns) to one PNG file, with separated and named blocks.

    Patterns without rows or columns are omitted. Raises `OutputError` if writing fails.
    """
    from matplotlib.figure import Figure

    rows = [kept for row in layout if (kept := [entry for entry in row if entry.nonzero_mask.size])]
    heights = [max(_inches(entry.nonzero_mask.shape[0]) for entry in row) for row in rows]
    widths = [[_inches(entry.nonzero_mask.shape[1]) for entry in row] for row in rows]
    figure = Figure(figsize=(max(map(sum, widths), default=4.0), max(sum(heights), 1.0)), layout="constrained")
    parts = figure.subfigures(max(len(rows), 1), 1, squeeze=False, height_ratios=heights or None)[:, 0]
    for part, row, shares in zip(parts, rows, widths, strict=False):
        for axes, entry in zip(part.subplots(1, len(row), squeeze=False, width_ratios=shares)[0], row, strict=True):
            _draw_pattern(axes, entry)
    _save(figure, path, dpi=110)


def _inches(count: int) -> float:
    return 2.2 + float(np.clip(0.11 * count, 1.2, 14.0))


def _draw_pattern(axes: Axes, pattern: SparsityPattern) -> None:
    from matplotlib.colors import ListedColormap

    shown, marked, width = pattern.nonzero_mask.astype(int), pattern.marked_mask, pattern.nonzero_mask.shape[1]
    title = f"{pattern.title}\n{len(shown)} x {width}, {pattern.n_nonzeros} entries can differ from zero"
    if marked is not None:
        shown[pattern.nonzero_mask & marked] = 2
        title += f"\ndark: {np.count_nonzero(shown == 2)} {pattern.mark_label}"
    colors = ListedColormap(["white", _NONZERO_COLOR if marked is None else _STRUCTURAL_COLOR, _NONZERO_COLOR])
    axes.imshow(shown, cmap=colors, vmin=0, vmax=2, interpolation="none", aspect="equal", origin="upper")
    axes.set_title(title, fontsize=9)
    top, right = axes.secondary_xaxis("top").xaxis, axes.secondary_yaxis("right").yaxis
    for axis, side, labels, blocks, line in (
        (axes.xaxis, top, pattern.column_labels, pattern.column_blocks, axes.axvline),
        (axes.yaxis, right, pattern.row_labels, pattern.row_blocks, axes.axhline),
    ):
        named = [block for block in blocks if block.stop > block.start]
        for block in (block for block in named if block is not blocks[0]):
            line(block.start - 0.5, color=_BLOCK_EDGE_COLOR, linewidth=0.7)
        places, names = _ticks(labels, blocks)
        axis.set_ticks(places, labels=names, fontsize=7)
        axis.set_tick_params(length=2)
        middles = [0.5 * (block.start + block.stop - 1) for block in named]
        side.set_ticks(middles, labels=[block.name for block in named], fontsize=8, color=_BLOCK_EDGE_COLOR)
        # names of narrow neighbours would be written over each other
        narrow = len(named) > 8 or any(block.stop - block.start < 0.03 * width for block in named)
        side.set_tick_params(length=0, labelrotation=90 if narrow and side is top else 0)
    axes.tick_params(axis="x", labelrotation=90)


def _ticks(labels: Sequence[str], spans: Sequence[NamedIndexRange]) -> tuple[list[float], list[str]]:
    """Return positions and texts of labels: all labels or, if they are many, one per owner (tube, arm) in a block."""
    if len(labels) <= _MAX_SINGLE_LABELS:
        return [float(i) for i in range(len(labels))], list(labels)
    places, names = [], []
    for span in spans:
        owners = [(labels[i].replace(".", "_").partition("_")[0], i) for i in range(span.start, span.stop)]
        for owner, group in groupby(owners, key=itemgetter(0)):
            indices = [i for _, i in group]
            places.append(0.5 * (indices[0] + indices[-1]))
            names.append(owner)
    return places, names
