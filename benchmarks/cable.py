"""Fit the real branched cable and predict recordings that the fit has not seen, beside predictions without a model.

    python benchmarks/cable.py [--folder FOLDER] [--json FILE] [--iterations N]

Free vertices are all but the two held at each end. A prediction knows the held vertices throughout and the free ones in
the first two frames; its error is the root mean square Euclidean distance over free vertices and later frames. Values
are per unit weight: the linear density is nominal, as no force was measured. `nominal` and `undeformed rest` are the
model with the measured undeformed shape as its rest shape, at guessed and at fitted stiffness and damping; for
`episode_with_fitted_initial_state` the rest shape was estimated as well.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

import yid_ocp as yid
from yid_ocp.data.channel_checks import typical_point_pair_distances
from yid_ocp.data.recording import Recording
from yid_ocp.data.recording_hdf5 import read_recording
from yid_ocp.model.objects.base import CableVertices
from yid_ocp.model.objects.cable import (
    CableBranchRigidityDampingAndDensity,
    CableOptions,
    clamped_cable_system,
    length_parameters_from_edges,
    read_vertex_positions_by_name,
)
from yid_ocp.problem import EstimationProblem, ProblemOptions, SensorOptions
from yid_ocp.problem.predictions import naive_cable_predictions
from yid_ocp.solvers import GaussNewton, fit_problem

FOLDER = Path(__file__).resolve().parents[2] / "shared" / "recordings" / "deft"
ESTIMATE = ("000", "007", "021", "035", "049", "063")
HELD_OUT = ("014", "028", "042", "056")
TIME_STEP = 0.01  # [s]
NOISE = 2e-4  # of motion capture, from the scatter of third differences (0.10 to 0.20 mm) [m]
MODEL_ERROR = 0.1  # about 15 mm that last for some fifty frames [m]
GRAVITY = 9.81  # [m/s^2]
BRANCH = CableBranchRigidityDampingAndDensity(
    bend_rigidity=1.5e-3, twist_rigidity=1e-3, bend_damping=1e-3, has_separate_twist_damping=True
)  # a guess
OPTIONS = CableOptions(default_branch=BRANCH, shape_memory_fraction=0.5, has_rest_angle_parameters=True)


def branched_cable(folder: Path = FOLDER) -> CableVertices:
    """The cable of the recordings: thirteen vertices of the parent, children leaving at the fifth and the ninth."""
    return CableVertices(
        tuple(f"p{i}" for i in range(13)),
        {"a": ("p4", "a1", "a2", "a3", "a4"), "b": ("p8", "b1", "b2", "b3")},
        read_vertex_positions_by_name(folder / "bdlo1_undeformed.csv"),
    )


def identifiable_cable_parameter_names(cable: CableVertices, options: CableOptions) -> tuple[str, ...]:
    """Names of the parameters that a cable's motion alone can identify: stiffness, damping and rest shape, no mass."""
    names: list[str] = []
    for name in cable.vertex_names_by_branch:
        names += [f"{name}.bend", f"{name}.twist", f"{name}.damping"]
        if options.branch_properties_by_name.get(name, options.default_branch).has_separate_twist_damping:
            names.append(f"{name}.twist_damping")
        if options.shape_memory_fraction is not None:
            names.append(f"{name}.memory")
    if options.shape_memory_fraction is not None:
        names.append("start.speed_scale")
    if options.has_rest_angle_parameters:
        for name, chain in cable.vertex_names_by_branch.items():
            links = len(chain) - (2 if name == cable.parent_segment else 1)
            names += [f"{name}_{i}_{axis}.rest" for i in range(links) for axis in "xy"]
    return tuple(names)


def cable_options(cable: CableVertices, recordings: list[Recording], options: CableOptions) -> ProblemOptions:
    """Of each recording what a prediction may use: the clamps throughout, free vertices in the first two frames."""
    known = {
        r.name: length_parameters_from_edges(cable, typical_point_pair_distances(cable.edge_vertex_names, [r], 2))
        for r in recordings
    }
    names = [name for name in identifiable_cable_parameter_names(cable, options) if name.endswith(".rest")]
    return ProblemOptions(
        initial_state="fitted_to_points",
        path_cutoff=8.0,
        sensors={"points": SensorOptions(std=MODEL_ERROR, used_points=cable.unclamped_vertex_names)},
        clamp_pose_point_names=cable.clamp_pose_point_names,
        prior_stds=dict.fromkeys(names, 0.2),
        initial_state_fit_window=TIME_STEP,
        start_point_noise_std=NOISE,
        initial_state_fit_parameters=("clamp_start.roll",),
        parameters_by_recording=known,
    )


def _position_rmse(predicted: np.ndarray, measured: np.ndarray) -> float:
    """Root mean square of the Euclidean error over points and frames, without the two given frames and gaps [m]."""
    return float(np.sqrt(np.nanmean(np.sum((predicted - measured)[2:] ** 2, axis=2))))


def point_rmse_by_recording(problem: EstimationProblem, x: np.ndarray, points: Sequence[str]) -> dict[str, float]:
    """Root mean square position error over some points, by recording, held-out ones included [m].

    NaN for a recording whose rollout fails. The first two frames are given and do not count.
    """
    errors, found = {}, problem.predict_held_out(x)
    for i, episode in enumerate(problem.episodes):
        own = problem.unpack_episode_unknowns(x, i)
        found.append((episode, problem.predictor.predict_episode(episode, *own, False)))
    for episode, result in found:
        if isinstance(result, str):
            errors[episode.name] = float("nan")
            continue
        for samples, predicted in zip(episode.measurements, result.predicted_outputs, strict=True):
            if samples.sensor.point_names == tuple(points):
                shape = (len(predicted), len(points), 3)
                errors[episode.name] = _position_rmse(predicted.reshape(shape), samples.value.reshape(shape))
    return errors


def baselines(recording: Recording, cable: CableVertices) -> dict[str, float]:
    """Prediction errors without a model [m]."""
    free, measured = cable.unclamped_vertex_names, recording.point_positions(cable.unclamped_vertex_names)
    predictions = naive_cable_predictions(recording, cable, free, cable.clamped_vertex_names)
    return {name: _position_rmse(predicted, measured) for name, predicted in predictions.items()}


def run(folder: Path = FOLDER, iterations: int = 15) -> dict[str, Any]:
    """Fit, predict, compare; seconds are wall time."""
    cable = branched_cable(folder)
    recordings = {name: read_recording(folder / f"bdlo1_train_{name}.h5") for name in (*ESTIMATE, *HELD_OUT)}
    estimate, held_out = [recordings[n] for n in ESTIMATE], [recordings[n] for n in HELD_OUT]
    clock = time.perf_counter()
    system = clamped_cable_system(typical_point_pair_distances(cable.edge_vertex_names, estimate), cable, OPTIONS)
    step = yid.compile_step(system, TIME_STEP)
    seconds = {"build_and_compile": time.perf_counter() - clock}
    options = cable_options(cable, estimate + held_out, OPTIONS)
    plain = {name: 0.0 for name in system.parameters.names if name.endswith(".memory")}
    names = identifiable_cable_parameter_names(cable, CableOptions(default_branch=BRANCH))
    undeformed = EstimationProblem(step, estimate, names, replace(options, prior_stds={}), plain, held_out)
    problem = EstimationProblem(
        step, estimate, identifiable_cable_parameter_names(cable, OPTIONS), options, None, held_out
    )
    clock = time.perf_counter()
    nominal = point_rmse_by_recording(undeformed, undeformed.initial_unknowns, cable.unclamped_vertex_names)
    point_rmse_by_recording(problem, problem.initial_unknowns, cable.unclamped_vertex_names)
    seconds["starts"] = time.perf_counter() - clock
    episode = problem.episodes[0]
    (theta, offset) = problem.unpack_episode_unknowns(problem.initial_unknowns, 0)
    clock = time.perf_counter()
    problem.predictor.predict_episode(episode, theta, offset, False)
    seconds["rollout"] = time.perf_counter() - clock
    clock = time.perf_counter()
    solution = fit_problem(problem, GaussNewton(max_iterations=iterations))
    seconds["fit"] = time.perf_counter() - clock
    fitted = point_rmse_by_recording(problem, solution.x, cable.unclamped_vertex_names)
    clock = time.perf_counter()
    simple = fit_problem(undeformed, GaussNewton(max_iterations=iterations))
    seconds["fit_undeformed_rest"] = time.perf_counter() - clock
    by_simple = point_rmse_by_recording(undeformed, simple.x, cable.unclamped_vertex_names)
    files = {}
    for recording in (*estimate, *held_out):
        errors = baselines(recording, cable)
        model = fitted[recording.name]
        files[recording.name] = {
            "held_out": recording in held_out,
            "error": model,
            "nominal": nominal[recording.name],
            "undeformed_rest": by_simple[recording.name],
            "baselines": errors,
            "ratio_to_linear_carry": errors["linear_carry"] / model,
        }
    return {
        "format": "yid-cable/1",
        "unit": "m",
        "given": "held vertices throughout, free vertices in the first two frames",
        "free_vertices": list(cable.unclamped_vertex_names),
        "files": files,
        "held_out_median": medians([entry for entry in files.values() if entry["held_out"]]),
        "parameters": parameters(cable, solution.x, solution.covariance, problem.unknown_names),
        "status": solution.status.value,
        "iterations": solution.n_iterations,
        "seconds": seconds,
    }


def medians(files: list[dict[str, Any]]) -> dict[str, float]:
    """Medians over files of every error, and the ratio of the strongest baseline's median to the model's."""
    result = {key: statistics.median(entry[key] for entry in files) for key in ("error", "nominal", "undeformed_rest")}
    result |= {name: statistics.median(e["baselines"][name] for e in files) for name in files[0]["baselines"]}
    result["ratio_to_linear_carry"] = result["linear_carry"] / result["error"]
    return result


def parameters(cable: CableVertices, x: Any, covariance: Any, names: tuple[str, ...]) -> dict[str, dict[str, Any]]:
    """Values, standard deviations, and values per unit weight (density times gravity) of rigidities and dampings."""
    units = {"bend": "m^3", "twist": "m^3", "damping": "m^3 s", "twist_damping": "m^3 s"}
    result: dict[str, dict[str, Any]] = {}
    for i, name in enumerate(names):
        branch, _, quantity = name.partition(".")
        result[name] = {"value": float(x[i]), "std": float(covariance[i, i]) ** 0.5}
        if branch in cable.vertex_names_by_branch and quantity in units:
            weight = OPTIONS.branch_properties_by_name.get(branch, OPTIONS.default_branch).linear_density * GRAVITY
            result[name] |= {"per_weight": float(x[i]) / weight, "per_weight_unit": units[quantity]}
    return result


def show(result: Mapping[str, Any], console: Console) -> None:
    """The same as tables."""
    table = Table(title="prediction error over free vertices and 5 s [mm], * held out")
    columns = ("file", "stays", "with clamps", "linear carry", "nominal", "undeformed rest", "fitted", "carry / fitted")
    for column in columns:
        table.add_column(column, justify="left" if column == "file" else "right", no_wrap=column == "file")

    def row(name: str, entry: Mapping[str, Any], plain: Mapping[str, float]) -> None:
        errors = [
            plain["stays"],
            plain["moves_with_clamps"],
            plain["linear_carry"],
        ]
        errors += [entry["nominal"], entry["undeformed_rest"], entry["error"]]
        table.add_row(name, *(f"{1e3 * e:.1f}" for e in errors), f"{entry['ratio_to_linear_carry']:.2f}")

    for name, entry in result["files"].items():
        row(f"{name}{' *' if entry['held_out'] else ''}", entry, entry["baselines"])
    row("median of *", result["held_out_median"], result["held_out_median"])
    console.print(table)
    values = Table(title="per unit weight")
    for column in ("parameter", "value", "relative std", "unit"):
        values.add_column(column)
    for name, entry in result["parameters"].items():
        if "per_weight" in entry:
            spread = entry["std"] / entry["value"] if entry["value"] else float("inf")
            values.add_row(name, f"{entry['per_weight']:.3g}", f"{spread:.2g}", entry["per_weight_unit"])
    console.print(values)
    spent = ", ".join(f"{name} {value:.2f}" for name, value in result["seconds"].items())
    console.print(f"{result['status']} after {result['iterations']} iterations; seconds: {spent}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--folder", type=Path, default=FOLDER)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--iterations", type=int, default=15)
    arguments = parser.parse_args()
    if not arguments.folder.is_dir():
        print(f"the recordings are not there: {arguments.folder}", file=sys.stderr)
        return 2
    result = run(arguments.folder, arguments.iterations)
    show(result, Console())
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
