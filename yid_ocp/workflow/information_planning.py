"""The goal `information` of the command `plan`: plans the most informative motion."""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from yid_ocp.config.settings import RunSettings
from yid_ocp.errors import DataError
from yid_ocp.planning.information_plan import InformativeMotionPlan, plan_informative_motion
from yid_ocp.progress import Progress
from yid_ocp.workflow.build import build_problem, locate_errors

_MAX_DISCRIMINATED_EFFECTS = 3
"""Effects that one motion is asked to separate, the likeliest ones."""


def read_parameter_run(run: RunSettings, commands: Sequence[str]) -> tuple[dict[str, Any], Path]:
    """Contents of result.json in the folder of `plan.parameter_run`, and the folder.

    Parameters
    ----------
    commands : sequence of str
        Whose folders may be given.

    Raises
    ------
    ConfigError, DataError
        There is no finished run, it is one of another command, or it failed.
    """
    folder = Path(str(run.plan.parameter_run))
    file = folder / "result.json"
    if not file.is_file() or not (folder / "trajectories.h5").is_file():
        what = f"there is no finished run of {' or '.join(f'`{command}`' for command in commands)} in {folder}"
        raise run.config_error(what, "plan", "parameter_run", hint="give the run folder that it printed")
    try:
        result: dict[str, Any] = dict(json.loads(file.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError, RecursionError) as error:
        raise DataError(f"the result cannot be read ({error})", where=str(file), hint="run it again") from error
    formats = {"solve": "yid-solve/", "diagnose": "yid-diagnosis/"}
    if not str(result.get("format", "")).startswith(tuple(formats[command] for command in commands)):
        what = f"{folder} is a run folder of another command ({result.get('format')})"
        raise run.config_error(
            what, "plan", "parameter_run", allowed=" or ".join(f"{formats[command]}1" for command in commands)
        )
    if result.get("status") == "failed":
        raise DataError(
            f"the solve in {folder} failed: {result['message']}", where=run.describe_location("plan", "parameter_run")
        )
    return result, folder


def plan_from_settings(run: RunSettings, progress: Progress) -> tuple[InformativeMotionPlan, dict[str, Any]]:
    """The most informative motion, and the source of its parameters: settings or a run folder.

    Raises
    ------
    ConfigError, DataError, ModelError, SolverError
    """
    problem = build_problem(run)
    free = {name: float(problem.theta[problem.system.parameters.index(name)]) for name in problem.free}
    sizes: dict[str, dict[str, float]] = {}
    source: dict[str, Any] = {"run": None, "parameters": free}
    if run.plan.parameter_run is not None:
        result, folder = read_parameter_run(run, ("solve", "diagnose"))
        found, sizes = parameter_and_effect_values(result)
        require_same_effects(run, found, problem.system.parameters.names)
        known = {name: value for name, value in found.items() if name in problem.system.parameters}
        source = {"run": str(folder), "parameters": free | known}
    with locate_errors(run, "plan"):
        plan = plan_informative_motion(problem, run.plan, source["parameters"], sizes, progress)
    return plan, source


def require_same_effects(run: RunSettings, found: Iterable[str], own: Collection[str]) -> None:
    """Raise an error where the run has parameters of effects that the plan's model lacks."""
    lacking = sorted({name.rpartition(".")[0] for name in found if "@" in name and name not in own})
    if lacking:
        what = f"{run.plan.parameter_run} was solved with {', '.join(lacking)}, which this model does not have"
        hint = "list the same effects under model.effects"
        raise run.config_error(what, "plan", "parameter_run", allowed="a run of `solve` on the same model", hint=hint)


def parameter_and_effect_values(result: Mapping[str, Any]) -> tuple[dict[str, float], dict[str, dict[str, float]]]:
    """Parameter values of a solve or diagnosis result, and effect sizes of a diagnosis, in display units."""
    if "parameters" in result:
        return {name: entry["value"] for name, entry in result["parameters"].items()}, {}
    sizes = {
        f"{entry['kind']}@{entry['location']}": {
            name: quantity["value"] for name, quantity in entry["parameters"].items() if quantity["value"] is not None
        }
        for entry in result["which"]
    }
    return {name: entry["before"] for name, entry in result["absorption"].items()}, sizes


def information_plan_result(run: RunSettings, found: InformativeMotionPlan) -> dict[str, Any]:
    """Entries of `yid-plan/1` for an informative motion."""
    pairs = [
        {"effect": first, "explained_by": second, "before": before, "after": after}
        for (first, second), (before, after) in found.effect_distances.items()
    ]
    return {
        "inform": None if run.plan.identify is None else list(run.plan.identify),
        "separate": None if run.plan.discriminate is None else list(run.plan.discriminate),
        "parameters": {
            name: {
                "std_relative_before": _number(known.std_recorded),
                "std_relative_after": _number(known.std_planned),
                "std_relative_together": _number(known.std_combined),
                "verdict": known.verdict,
            }
            for name, known in found.parameter_precisions.items()
        },
        "distances": pairs,
        "starts": [
            {
                "first": start.initial_criterion,
                "value": start.final_criterion,
                "judged": _number(start.configured_criterion),
                "finished": start.is_converged,
                "rounds": start.n_iterations,
            }
            for start in found.start_results
        ],
        "best": found.best_start_index,
        "limits_reached": {what: list(names) for what, names in found.active_limits.items()},
        "unseen": dict(found.unobservable_parameters),
        "open": list(found.unidentifiable_directions),
    }


def next_plan_settings(confusable: Sequence[Sequence[Mapping[str, str]]], folder: Path) -> dict[str, Any] | None:
    """Settings of `plan` for a motion that discriminates confusable effects; None without any."""
    if not confusable:
        return None
    labels = [f"{entry['kind']}@{entry['location']}" for entry in confusable[0]]
    return {"goal": "information", "discriminate": labels[:_MAX_DISCRIMINATED_EFFECTS], "parameter_run": str(folder)}


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None
