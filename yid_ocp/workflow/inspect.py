"""The command `inspect`: the symbolic side of a run's model in numbers, a picture and matrices."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from yid_ocp.analysis.inspection import Linearisation, inspect_step, linearise, sparsity_picture
from yid_ocp.config.settings import Run, dump_config
from yid_ocp.errors import ModelError
from yid_ocp.integrator.statics import Statics
from yid_ocp.integrator.step import Step
from yid_ocp.problem import EstimationProblem
from yid_ocp.workflow.build import build_problem, build_step, parameter_settings
from yid_ocp.workflow.folder import Monitor, Silent, input_hashes, new_run_folder, versions

FORMAT = "yid-inspect/1"
Array = NDArray[np.float64]


@dataclass(frozen=True)
class InspectOutcome:
    """What `run_inspect` leaves: the run folder and the contents of its result.json."""

    folder: Path
    result: dict[str, Any]


def run_inspect(run: Run, out: str | Path | None = None, monitor: Monitor | None = None) -> InspectOutcome:
    """Write result.json, sparsity.png and linearisation.h5 of a run's model.

    Parameters
    ----------
    run : Run
    out : str or Path, optional
    monitor : Monitor, optional

    Raises
    ------
    ConfigError, DataError, ModelError, OutputError
    """
    watcher = monitor or Silent()
    with new_run_folder(run, out, "inspect") as folder:
        folder.write("config.yaml", dump_config(run))
        inputs = input_hashes(run)
        folder.log("start", command="inspect", versions=versions(), inputs=inputs)
        watcher.stage("building the model and its compiled step")
        begun = time.perf_counter()
        step = build_step(run)
        seconds = time.perf_counter() - begun
        free = {name for name, said in parameter_settings(run, step.system.parameters).items() if said.free}
        watcher.stage("linearising")
        problem = build_problem(run, step) if run.recordings.estimate and free else None
        at, linearisation, torque = _linearised(step, problem)
        sparsity_picture(step, folder.path / "sparsity.png")
        _write_matrices(folder.path / "linearisation.h5", step, linearisation, torque)
        inspection = inspect_step(step)
        result = {
            "format": FORMAT,
            "build_seconds": seconds,
            "compiled": step.compiled,
            "variables": _variables(step),
            "parameters": {
                entry.name: {
                    "value": entry.value,
                    "unit": entry.unit,
                    "lower": entry.lower,
                    "upper": entry.upper,
                    "free": entry.name in free,
                    "description": entry.description,
                }
                for entry in step.system.parameters
            },
            "equations": asdict(inspection),
            "linearisation": {
                "at": at,
                "spectral_radius": linearisation.spectral_radius,
                "norms": {
                    name: float(np.linalg.norm(matrix))
                    for name, matrix in (
                        ("A", linearisation.a),
                        ("B_u", linearisation.b_input),
                        ("B_theta", linearisation.b_theta),
                    )
                },
                "finite_difference_errors": linearisation.errors,
            },
            "inputs": inputs,
            "versions": versions(),
        }
        written = folder.write_json("result.json", result)
    return InspectOutcome(folder.path, written)


def _variables(step: Step) -> list[dict[str, str]]:
    system = step.system
    roles = dict.fromkeys(system.driven, "driven") | dict.fromkeys(system.prescribed, "prescribed")
    return [
        {"name": joint.name, "unit": joint.unit, "role": roles.get(joint.name, "free")}
        for joint in system.mechanism.joints
    ]


def _linearised(step: Step, problem: EstimationProblem | None) -> tuple[str, Linearisation, Array]:
    system, sizes = step.system, step.sizes
    theta = system.parameters.vector()
    known = np.zeros(len(system.driven) + len(system.prescribed))
    torque, at = None, "rest with all known coordinates at zero"
    if problem is not None:
        episode = problem.episodes[0]
        known, at = episode.posture, f"rest at the first posture of {episode.name}"
        torque = episode.torque[0] if system.driven else None
        theta = problem.predictor.own_theta(episode, theta)
    rest = Statics(step).solve(known, theta, torque)
    state, holding = rest.state, rest.torque
    if not rest.converged:
        at = f"zero, since there is no rest: {rest.message}"
        state, holding = np.zeros(sizes["nx"]), np.zeros(sizes["nu"])
        known = np.zeros_like(known)
    path = known[len(system.driven) :]
    pair = (path, path) if len(path) else None
    try:
        return at, linearise(step, state, holding, theta, pair), holding
    except np.linalg.LinAlgError as error:
        raise ModelError("the step cannot be linearised: its equations are singular", where=at) from error


def _write_matrices(path: Path, step: Step, linearisation: Linearisation, torque: Array) -> None:
    with h5py.File(path, "w") as file:
        file.attrs["format"] = "yid-linearisation/1"
        file.attrs["time_step"] = step.time_step
        text = h5py.string_dtype()
        file.attrs["joints"] = np.array(step.system.mechanism.joint_names, dtype=text)
        file.attrs["inputs"] = np.array(step.system.driven, dtype=text)
        file.attrs["parameters"] = np.array(step.system.parameters.names, dtype=text)
        for name, matrix in (
            ("state", linearisation.state),
            ("torque", torque),
            ("A", linearisation.a),
            ("B_u", linearisation.b_input),
            ("B_theta", linearisation.b_theta),
        ):
            file.create_dataset(name, data=matrix)
