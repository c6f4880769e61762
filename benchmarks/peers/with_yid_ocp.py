"""This package, through its Python interface; a case's YAML file is counted with its lines."""

from __future__ import annotations

from answer import Answer
from cases import Trial

import yid_ocp as yid
from yid_ocp.problem.predictions import rmse_unit_count_dicts_by_channel


def solve(trial: Trial) -> Answer:
    problem = yid.load_problem(trial.config, trial.overrides)
    solution = yid.solve(problem)
    own = {name: entry for name, entry in solution.parameters.items() if entry.free}
    return Answer(
        {name: entry.value for name, entry in own.items()},
        {name: entry.confidence_interval_ends for name, entry in own.items()},
        tuple(name for name, entry in own.items() if entry.verdict != "identifiable"),
        tuple(f"{name}: {entry.verdict}" for name, entry in own.items())
        + tuple(issue.what for issue in solution.checks.data_issues),
    )


def servo(trial: Trial) -> Answer:
    problem = yid.load_problem(trial.config, trial.overrides)
    solution = yid.solve(problem)
    free = {name: entry for name, entry in solution.parameters.items() if entry.free}
    errors = [
        next(iter(rmse_unit_count_dicts_by_channel([predicted], [episode]).values()))["rmse"]
        for episode, predicted in solution.checks.held_out_predictions
    ]
    ends = {name: entry.confidence_interval_ends for name, entry in free.items()}
    doubted = tuple(name for name, entry in free.items() if entry.verdict != "identifiable")
    return Answer({name: entry.value for name, entry in free.items()}, ends, doubted, held_out=tuple(errors))


BY_CASE = dict.fromkeys(("foam", "foam_noise", "payload", "springs", "scaled_torque"), solve) | {"servo": servo}
