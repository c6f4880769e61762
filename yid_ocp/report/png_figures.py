"""Matplotlib figures written as PNG files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from yid_ocp.analysis.compare import MethodComparison
from yid_ocp.errors import OutputError

if TYPE_CHECKING:
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
    """Rates with their intervals; nothing where there are none."""
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
