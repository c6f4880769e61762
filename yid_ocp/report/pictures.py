"""Pictures written as PNG without a display."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from yid_ocp.analysis.compare import Comparison
from yid_ocp.errors import OutputError


def draw_convergence(path: Path, comparison: Comparison) -> None:
    """Cost of every method against iterations and against time, over the lowest cost that it reached.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 4.4), layout="constrained")
    by_iteration, by_time = figure.subplots(1, 2, sharey=True)
    for run in comparison.runs:
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
    try:
        figure.savefig(path, dpi=120)
    except OSError as error:
        raise OutputError(f"the picture cannot be written: {error.strerror}", where=str(path)) from error
