"""Draw a diagnosis in one picture: the gap on a held-out motion, where it lies and when, which effect makes it.

yid-ocp diagnose --out RUN && python benchmarks/diagnosis_picture.py RUN docs/pictures/diagnosis.png
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

BEFORE, AFTER, MEASURED = "#b3541e", "#1f6f8b", "#666666"
RUNNING = 25  # samples of a running root mean square


def running(square: np.ndarray) -> np.ndarray:
    """Root of a running mean."""
    window = np.ones(RUNNING)
    return np.sqrt(np.convolve(square, window, mode="same") / np.convolve(np.ones(len(square)), window, mode="same"))


def draw_gap(axes: Axes, folder: h5py.Group) -> None:
    """Error of the point that is sampled most often, before and after."""
    group = max((entry for entry in folder.values() if "before" in entry), key=lambda entry: len(entry["t"]))
    t, measured = group["t"][:], group["measured"][:, :3]
    for name, color, words in (("before", BEFORE, "nominal model"), ("after", AFTER, "with the effect")):
        square = np.sum((group[name][:, :3] - measured) ** 2, axis=1)
        axes.plot(t, 1e3 * running(square), color=color, label=words)
    noise = np.sqrt(np.sum(group["std"][:, :3] ** 2, axis=1).mean())
    axes.axhline(1e3 * noise, color=MEASURED, linestyle=":", label="noise")
    axes.set(xlabel="time [s]", ylabel="error [mm]", ylim=(0, None))
    axes.set_title(f"Is there a gap? {group.attrs['channels'][0]}, held out", fontsize=10)
    axes.legend(frameon=False, fontsize=8)


def draw_where(axes: Axes, folder: h5py.Group) -> None:
    """Root mean square of the unknown forces at every place over their standard deviations, over time."""
    kinds, locations = folder.attrs["kinds"], folder.attrs["locations"]
    edges, mean, std = folder["edges"][:], folder["mean"][:], folder["std"][:]
    force = np.isin(kinds, ["force", "push"])
    ratio = np.divide(mean, std, out=np.zeros_like(mean), where=std > 0)  # nothing acts where none is looked for
    places = list(dict.fromkeys(locations[force]))
    values = np.stack([np.sqrt(np.mean(ratio[:, force & (locations == place)] ** 2, axis=1)) for place in places])
    mesh = axes.pcolormesh(edges, np.arange(len(places) + 1), values, cmap="magma_r", vmin=0, vmax=values.max())
    axes.set_yticks(np.arange(len(places)) + 0.5, places, fontsize=8)
    axes.invert_yaxis()
    axes.set_xlabel("time [s]")
    axes.set_title("Where? unknown force over its std", fontsize=10)
    axes.figure.colorbar(mesh, ax=axes)


def draw_which(axes: Axes, which: list[dict[str, Any]]) -> None:
    """What every effect that was fitted closes on held-out motions."""
    fitted = [entry for entry in which if entry["closure"] is not None][:6]
    names = [f"{entry['kind']}\n{entry['location']}" for entry in fitted]
    closed = [100 * entry["closure"] for entry in fitted]
    axes.barh(names, closed, color=[AFTER, *[MEASURED] * (len(fitted) - 1)])
    axes.invert_yaxis()
    axes.axvline(0.0, color="black", linewidth=0.6)
    axes.tick_params(axis="y", labelsize=8)
    axes.set_xlabel("of the held-out gap closed [%]")
    axes.set_title("Which effect?", fontsize=10)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="run folder of `yid-ocp diagnose`")
    parser.add_argument("picture", type=Path, help="PNG to write")
    arguments = parser.parse_args()
    result = json.loads((arguments.run / "result.json").read_text(encoding="utf-8"))
    figure = Figure(figsize=(11.0, 3.2), layout="constrained")
    gap, where, which = figure.subplots(1, 3, width_ratios=(1.0, 1.1, 0.9))
    with h5py.File(arguments.run / "trajectories.h5") as file:
        draw_gap(gap, file[result["gap"]["held_out"][0]])
        draw_where(where, next(iter(file["where"].values())))
    draw_which(which, result["which"])
    figure.savefig(arguments.picture, dpi=100)


if __name__ == "__main__":
    main()
