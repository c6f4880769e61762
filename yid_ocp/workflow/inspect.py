"""The command `inspect`: the symbolic side of a run's model in numbers, a picture and matrices."""

from __future__ import annotations

import argparse
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from yid_ocp.analysis.inspection import Linearisation, inspect_step, linearise, sparsity_picture
from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import Run
from yid_ocp.errors import ModelError
from yid_ocp.integrator.statics import Statics
from yid_ocp.integrator.step import Step
from yid_ocp.problem import EstimationProblem
from yid_ocp.report.terminal import inspect_summary
from yid_ocp.workflow.build import build_problem, build_step, parameter_settings
from yid_ocp.workflow.command import DONE, carry_out
from yid_ocp.workflow.folder import new_run_folder
from yid_ocp.workflow.progress import SILENT, Progress

FORMAT = "yid-inspect/1"
Array = NDArray[np.float64]


@dataclass(frozen=True)
class InspectOutcome:
    """What `run_inspect` leaves: the run folder and the contents of its result.json."""

    folder: Path
    result: dict[str, Any]


def run(arguments: argparse.Namespace) -> int:
    """The command."""
    settings = load_config(arguments.config, arguments.overrides)
    carry_out(lambda shown: run_inspect(settings, arguments.out, shown), inspect_summary, arguments.quiet)
    return DONE


def run_inspect(run: Run, out: str | Path | None = None, progress: Progress = SILENT) -> InspectOutcome:
    """Write result.json, sparsity.png and linearisation.h5 of a run's model.

    Parameters
    ----------
    run : Run
    out : str or Path, optional
    progress : Progress, optional

    Raises
    ------
    ConfigError, DataError, ModelError, OutputError
    """
    with new_run_folder(run, out, "inspect") as folder:
        folder.begin(run, "inspect")
        progress.stage("building the model and its compiled step")
        begun = time.perf_counter()
        step = build_step(run)
        seconds = time.perf_counter() - begun
        free = {name for name, said in parameter_settings(run, step.system.parameters).items() if said.free}
        progress.stage("linearising")
        problem = build_problem(run, step) if run.recordings.estimate and free else None
        at, linearisation, torque = _linearised(step, problem)
        sparsity_picture(step, folder.path / "sparsity.png")
        _write_matrices(folder.path / "linearisation.h5", step, linearisation, torque)
        result = {
            "format": FORMAT,
            "build_seconds": seconds,
            "compiled": step.compiled,
            "variables": _variables(step),
            "parameters": _parameters(step, free),
            "equations": asdict(inspect_step(step)),
            "linearisation": {
                "at": at,
                "spectral_radius": linearisation.spectral_radius,
                "norms": {
                    "A": float(np.linalg.norm(linearisation.a)),
                    "B_u": float(np.linalg.norm(linearisation.b_input)),
                    "B_theta": float(np.linalg.norm(linearisation.b_theta)),
                },
                "finite_difference_errors": linearisation.errors,
            },
        }
        written = folder.finish(result)
    return InspectOutcome(folder.path, written)


def _parameters(step: Step, free: set[str]) -> dict[str, dict[str, Any]]:
    return {
        entry.name: {
            "value": entry.value,
            "unit": entry.unit,
            "lower": entry.lower,
            "upper": entry.upper,
            "free": entry.name in free,
            "description": entry.description,
        }
        for entry in step.system.parameters
    }


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
