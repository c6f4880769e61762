"""Discretisation check: shifts of estimates and frequencies with finer links or shorter time steps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from yid_ocp.analysis.discretisation import (
    DiscretisationShift,
    NaturalFrequencies,
    RefinedProblem,
    StepErrorGrowth,
    discretisation_shifts,
    inflate_estimates,
    joint_subdivision,
    largest_error_growth,
    natural_frequencies,
)
from yid_ocp.config.settings import RunSettings
from yid_ocp.errors import YidError
from yid_ocp.inference.uncertainty import typical_parameter_sizes
from yid_ocp.integrator.step import with_time_step
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.evaluation import Evaluation
from yid_ocp.progress import NULL_PROGRESS, Progress
from yid_ocp.solvers import Solution, Status
from yid_ocp.workflow.build import build_step, build_system, link_division_factor

Array = NDArray[np.float64]
_Refinement = Literal["links", "time_step"]

_FREQUENCY_TOLERANCE = (
    0.02  # a frequency that moves by more than this fraction when links or steps are refined is worth a warning
)
_N_MODES = 3
_MIN_STEPS_TO_COMPILE = (
    2000  # steps of one evaluation from which on compiling a finer model takes less time than it saves
)


# -- estimates --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class DiscretisationShifts:
    """Shifts of the estimates with a finer discretisation.

    Attributes
    ----------
    estimate_shifts : mapping of parameter to DiscretisationShift
        Of every shared free parameter; empty where nothing was tried.
    notes : tuple of str
        Why something that was asked for is not known.
    """

    estimate_shifts: Mapping[str, DiscretisationShift]
    notes: tuple[str, ...] = ()

    def to_result(self, std: Mapping[str, float]) -> dict[str, Any]:
        """Shifts for result.json in the parameter's unit, with the standard deviation from the data alone."""
        return {name: {**asdict(own), "std": std.get(name)} for name, own in self.estimate_shifts.items()}


def requested_refinements(run: RunSettings) -> tuple[_Refinement, ...]:
    """Refinements that a run's settings request after a solve.

    Where they do not say: the time step, and the links too where they stand for something that bends everywhere
    (`ObjectKind.default_link_refinement`).
    """
    said = run.output.discretisation_check
    if said is None:
        item = run.model.object
        said = "both" if item is not None and item.default_link_refinement else "time_step"
    return {"none": (), "time_step": ("time_step",), "both": ("links", "time_step")}[said]  # type: ignore[return-value]


def measure_discretisation_shifts(
    run: RunSettings,
    problem: EstimationProblem,
    x: Array,
    at_x: Evaluation,
    what: tuple[_Refinement, ...],
    progress: Progress = NULL_PROGRESS,
    *,
    models_alone: bool = False,
) -> DiscretisationShifts:
    """Shifts of the estimates when every link is divided in two and when the time step is halved.

    Parameters
    ----------
    x : ndarray, shape (nx,)
    at_x : Evaluation
        With its Jacobian.
    models_alone : bool
        At a point that is no estimate; see `discretisation_shifts`.
    """
    found: dict[str, dict[str, float]] = {}
    notes: list[str] = []
    for key in what:
        words = "twice the links" if key == "links" else "half the time step"
        if key == "links" and _object_link_count(run) is None:
            continue
        progress.begin_stage(f"trying {words}")
        try:
            refined = _with_twice_the_links(run, problem) if key == "links" else _with_half_the_step(problem)
            own = discretisation_shifts(refined, problem, x, at_x, model_difference_only=models_alone)
        except YidError as error:
            own = error.what
        if isinstance(own, str):
            notes.append(f"what {words} would change is not known: {own}")
        else:
            found[key] = own
    names = problem.shared_parameters if found else ()
    made = {
        name: DiscretisationShift(*(found.get(key, {}).get(name) for key in ("links", "time_step"))) for name in names
    }
    return DiscretisationShifts(made, tuple(notes))


def with_discretisation_uncertainty(solution: Solution, found: DiscretisationShifts) -> Solution:
    """The solution with stds and verdicts that include the discretisation shifts."""
    sizes = {} if solution.problem is None else typical_parameter_sizes(solution.problem, solution.x)
    return replace(solution, parameters=inflate_estimates(solution.parameters, found.estimate_shifts, sizes))


def _with_twice_the_links(run: RunSettings, problem: EstimationProblem) -> RefinedProblem:
    system, options = build_system(run, link_division=2), problem.options
    steps = sum(episode.grid.steps for episode in problem.episodes)
    compiled = problem.step.is_compiled and steps > _MIN_STEPS_TO_COMPILE
    step = build_step(replace(run, problem=replace(run.problem, use_compiler=compiled)), system)
    factors = {name: float(link_division_factor(run, name, 2)) for name in system.parameters.names}
    priors = {name: std * factors.get(name, 1.0) for name, std in options.prior_stds.items()}
    recordings = [episode.recording for episode in problem.episodes]
    options = replace(options, prior_stds=priors, multivariate_prior=options.multivariate_prior.scaled_by(factors))
    made = EstimationProblem(step, recordings, problem.free, options)
    return RefinedProblem(made, factors, joint_subdivision(problem.system, system))


def _with_half_the_step(problem: EstimationProblem) -> RefinedProblem:
    step = with_time_step(problem.step, problem.step.time_step / 2)
    recordings = [episode.recording for episode in problem.episodes]
    return RefinedProblem(EstimationProblem(step, recordings, problem.free, problem.options))


# -- stability --------------------------------------------------------------------------------------------------------


def with_stability_check(problem: EstimationProblem, solution: Solution) -> tuple[Solution, dict[str, Any]]:
    """The solution, marked as not converged where the step is unstable, and stability data for result.json.

    Along the recorded motions, at the start of the search and at the estimate. A search may begin where the step is not
    stable and leave that place; one that ends there has followed the step's own errors.
    """
    begin, end = largest_error_growth(problem, problem.initial_unknowns), largest_error_growth(problem, solution.x)
    found = {"start": _growth_result(begin), "estimate": _growth_result(end)}
    if end is not None and not end.is_stable:
        status = Status.STALLED if solution.status == Status.CONVERGED else solution.status
        return replace(
            solution, status=status, message=f"at the estimate {end.description} ({solution.message})"
        ), found
    if solution.status == Status.FAILED and begin is not None and not begin.is_stable:
        return replace(solution, message=f"at the start {begin.description} ({solution.message})"), found
    return solution, found


def _growth_result(growth: StepErrorGrowth | None) -> dict[str, Any] | None:
    if growth is None:
        return None
    return {
        "recording": growth.recording_name,
        "decades": growth.growth_decades,
        "factor": growth.max_step_factor,
        "time": growth.max_growth_time,
        "time_step": growth.time_step,
    }


# -- frequencies ------------------------------------------------------------------------------------------------------


def frequency_convergence(run: RunSettings, problem: EstimationProblem | None, warnings: list[str]) -> dict[str, Any]:
    """Lowest natural frequencies with twice the links and with half and a quarter of the time step.

    Returns
    -------
    dict
        `links` and `time_step`: lists of {value, hertz, growing, message}; empty where there is nothing to vary.
    """
    system = build_system(run)
    h = run.problem.time_step
    posture = _posture(system, problem)
    if posture is None:
        return {"links": [], "time_step": [], "message": "no posture is known: the run names no recording"}
    theta, guess = system.parameters.vector(), None
    rule = (run.problem.force_split, run.problem.constraint_force)
    if problem is not None:
        first = problem.episodes[0]
        theta = problem.predictor.episode_theta(first, theta)
        guess = None if first.fixed_initial_state is None else first.fixed_initial_state.state[: system.n_coordinates]
    own = natural_frequencies(system, posture, theta, h, *rule, guess)
    if own.message:
        return {"links": [], "time_step": [], "message": own.message}
    if own.n_unstable_modes:
        remedy = "problem.constraint_force: midpoint, " if rule[1] == "node" and system.grasps else ""
        warnings.append(
            f"{own.n_unstable_modes} modes grow from step to step about the first posture: take a shorter "
            f"problem.time_step, {remedy}or more damping"
        )
    values = dict(zip(system.parameters.names, theta, strict=True))
    steps = [_row(h, own)]
    steps += [_row(h / k, natural_frequencies(system, posture, theta, h / k, *rule, guess)) for k in (2, 4)]
    _warn(warnings, "the time step goes", "s", steps, len(steps) - 1, 0)
    count = _object_link_count(run)
    rows = []
    if count is not None:
        other = build_system(run, link_division=2)
        scaled = other.parameters.vector(
            {
                name: value * link_division_factor(run, name, 2)
                for name, value in values.items()
                if name in other.parameters
            }
        )
        rows = [_row(count, own), _row(2 * count, natural_frequencies(other, posture, scaled, h, *rule))]
        _warn(warnings, "the links go", "", rows, 1, 0)
    return {"links": rows, "time_step": steps, "message": ""}


def _object_link_count(run: RunSettings) -> int | None:
    return None if run.model.object is None else run.model.object.link_count


def _posture(system: Any, problem: EstimationProblem | None) -> dict[str, float] | None:
    names = (*system.driven, *system.prescribed)
    if not names:
        return {}
    if problem is None:
        return None
    return dict(zip(names, map(float, problem.episodes[0].initial_known_coordinates), strict=True))


def _row(value: float, found: NaturalFrequencies) -> dict[str, Any]:
    return {
        "value": value,
        "hertz": found.frequencies_hz[:_N_MODES].tolist(),
        "growing": found.n_unstable_modes,
        "message": found.message,
    }


def _warn(warnings: list[str], what: str, unit: str, rows: list[dict[str, Any]], finest: int, own: int) -> None:
    fine, coarse = rows[finest]["hertz"], rows[own]["hertz"]
    for i, (a, b) in enumerate(zip(coarse, fine, strict=False)):
        if b > 0 and abs(a - b) / b > _FREQUENCY_TOLERANCE:
            change = f"from {rows[own]['value']:g} to {rows[finest]['value']:g} {unit}".rstrip()
            moved = f"{a:.3g} Hz to {b:.3g} Hz ({100 * abs(a - b) / b:.2g} %)"
            warnings.append(f"frequency {i + 1} moves from {moved} when {what} {change}")
